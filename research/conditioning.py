"""Whether a Proposer conditions on the Solver.

It is shown Solvers at several stages of training, then the same with the probes or the return of
another one. If nothing that it proposes changes, it does not condition on the Solver.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.cli.build import StoredRun, make_task, stored_run
from proposer_rl.cli.config import saved_config
from proposer_rl.curricula import ProposerCurriculum
from proposer_rl.methods import Components, frozen_proposer
from proposer_rl.models import draw_at, uniform_noise
from proposer_rl.streams import Streams
from proposer_rl.task import Space, Task
from research.common import Rows, answer, parser_of

SAMPLES = 64  # batches drawn from a policy to know its mean composition


class Seen(NamedTuple):
    """A Solver at some stage of training, and what the Proposer sees of it, batch [1]."""

    updates: int
    seen: TensorDict


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    answer(_parser().parse_args(arguments), _rows, _table)


def _rows(options: argparse.Namespace) -> Rows:
    """What a Proposer proposes to the Solver of every checkpoint, and to mixtures of Solvers.

    For every stage and everything that is seen of a Solver, in turn taken from the first or the
    last stage instead: the mean of the proposals along each axis of the space, and their distance
    (total variation, 0 to 1) from those to the Solver as it is.
    """
    proposer, seed = options.proposer, options.seed
    config = saved_config(proposer)
    task = make_task(config)
    frozen = frozen_proposer(Components(task, config.proposer, seed), checkpoint=str(proposer))
    frozen.view.draw_levels(Streams(seed, "look"))
    stages = _stages(task, frozen, stored_run(options.solvers))
    rows = []
    for stage in stages:
        shares = _shares(frozen, stage.seen, task.batch_size)
        rows.append(_row(task.space, stage, "as it is", shares, shares))
        for part in ("probes", *config.proposer.observes):
            for name, other in (("first", stages[0]), ("last", stages[-1])):
                if part == "progress" or other is stage:
                    continue
                swapped = stage.seen.clone().set(part, other.seen[part])
                changed = _shares(frozen, swapped, task.batch_size)
                rows.append(_row(task.space, stage, f"{part} of the {name}", changed, shares))
    return [{"run": proposer.name, **row} for row in rows]


def _stages(task: Task, frozen: ProposerCurriculum, solvers: StoredRun) -> list[Seen]:
    learner = task.learner([Streams(0)])
    stages = []
    for stage in map(solvers.stage, solvers.files):
        learner.restore(stage.solver)
        stages.append(Seen(stage.updates, frozen.view.observe(learner.agent, 0.0)))
    return stages


@torch.no_grad()
def _shares(frozen: ProposerCurriculum, seen: TensorDict, batch_size: int) -> Tensor:
    """Mean composition of the proposals, float [N]."""
    distribution = frozen.agent.distribution(frozen.agent(seen.expand(SAMPLES).clone()))
    if frozen.own_action == "mode":
        action = distribution.mode
    else:
        # One generator for all: the same numbers for whatever is seen, so that only that differs.
        generator = Streams(0, "look").generator()
        shape = torch.Size([1, *distribution.batch_shape, *distribution.event_shape])
        action = draw_at(distribution, uniform_noise(shape, 1, [generator], seen.device)[0, 0])
    generators = [Streams(0, "look", k).generator() for k in range(SAMPLES)]
    choices = frozen.actions.draw(action.cpu(), batch_size, generators)
    return choices.flatten().bincount(minlength=frozen.actions.bins) / choices.numel()


def _row(space: Space, stage: Seen, what: str, shares: Tensor, reference: Tensor) -> dict[str, Any]:
    table = shares.unflatten(0, [len(values) for values in space.axes.values()])
    means = {
        name: float((table.movedim(i, 0).flatten(1).sum(1) * torch.tensor(values)).sum())
        for i, (name, values) in enumerate(space.axes.items())
    }
    return {
        "updates": stage.updates,
        "return": float(stage.seen["return"]),
        "seen": what,
        **means,
        "distance": float((shares - reference).abs().sum() / 2),
        "distance_from_uniform": float((shares - 1 / space.size).abs().sum() / 2),
        "shares": table.tolist(),
    }


def _table(run: str, rows: Rows) -> Table:
    numbers = [key for key in rows[0] if key not in ("run", "updates", "seen", "shares")]
    table = Table(
        "updates", "seen of the Solver", *(name.replace("_", " ") for name in numbers), title=run,
        caption="Means of the proposals along each axis; distances are total variation: from the "
        "proposals to the Solver as it is, and from the uniform mixture.",
    )  # fmt: skip
    for row in rows:
        table.add_row(str(row["updates"]), row["seen"], *(f"{row[key]:.3f}" for key in numbers))
    return table


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(
        "conditioning",
        "Shows what a Proposer proposes to Solvers at several stages of training, and what changes "
        "when it is shown the probes or the return of another Solver.",
        "the levels that it is shown the Solver on",
    )
    parser.add_argument("proposer", type=Path, help="folder of a run with a Proposer")
    parser.add_argument("solvers", type=Path, help="folder of a run; all its checkpoints are shown")
    return parser


if __name__ == "__main__":
    main()
