"""``bin/look`` and ``proposer-look``: does a Proposer look at the Solver?"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import ConfigError, saved_config
from proposer_rl.cli.snr import checkpoints, refuse
from proposer_rl.curricula import FrozenProposer
from proposer_rl.mazes.task import MazeTask
from proposer_rl.methods import Parts, frozen_proposer
from proposer_rl.models import draw, uniform_noise
from proposer_rl.runs.checkpoint import CheckpointError, load_checkpoint
from proposer_rl.runs.folder import write_atomically
from proposer_rl.streams import Streams

SAMPLES = 64  # batches drawn from a policy to know its mean composition


class Stage(NamedTuple):
    """A Solver at some stage of training, and what the Proposer sees of it, batch [1]."""

    updates: int
    seen: TensorDict


def main() -> None:
    """Entry point: exit code 0, 2 for bad input."""
    arguments = _parser().parse_args()
    try:
        rows = look(arguments.proposer, arguments.solvers, arguments.seed)
    except (ConfigError, CheckpointError, ValueError, OSError) as error:
        refuse(str(error))
    _print(rows)
    if arguments.output is not None:
        write_atomically(arguments.output, (json.dumps(rows, indent=1) + "\n").encode())


def look(proposer: Path, solvers: Path, seed: int = 0) -> list[dict[str, Any]]:
    """What a Proposer proposes to the Solver of every checkpoint, and to mixtures of Solvers.

    Args:
        proposer: the folder of the run that it learnt in.
        solvers: the folder of the run whose checkpoints hold the Solvers; same mazes.
        seed: of the validation and probe levels.

    Returns:
        For every stage and everything that is seen of a Solver, in turn taken from the first or the
        last stage instead: the mean obstacle fraction and path length of the proposals, and their
        distance (total variation, 0 to 1) from those to the Solver as it is.
    """
    config = saved_config(proposer)
    task = make_task(config)
    frozen = frozen_proposer(Parts(task, config.proposer, seed), str(proposer))
    assert isinstance(frozen, FrozenProposer)
    frozen.view.draw_levels(Streams(seed, "look"))
    stages = _stages(task, frozen, checkpoints(solvers))
    rows = []
    for stage in stages:
        shares = _shares(frozen, stage.seen, task.solver.problems)
        rows.append(_row(task, stage, "as it is", shares, shares))
        for part in ("probes", *config.proposer.observes):
            for name, other in (("first", stages[0]), ("last", stages[-1])):
                if part == "progress" or other is stage:
                    continue
                swapped = stage.seen.clone().set(part, other.seen[part])
                changed = _shares(frozen, swapped, task.solver.problems)
                rows.append(_row(task, stage, f"{part} of the {name}", changed, shares))
    return rows


def _stages(task: MazeTask, frozen: FrozenProposer, files: list[Path]) -> list[Stage]:
    solver = task.solvers([Streams(0)])
    stages = []
    for file in files:
        _, state = load_checkpoint(file)
        solver.restore(TensorDict(state["solver"], [1]))
        stages.append(Stage(state["updates"], frozen.view.observe(solver.agent, 0.0)))
    return stages


@torch.no_grad()
def _shares(frozen: FrozenProposer, seen: TensorDict, problems: int) -> Tensor:
    """Mean composition of the proposals, float [N]."""
    distribution = frozen.agent.distribution(frozen.agent(seen.expand(SAMPLES).clone()))
    if frozen.own_action == "mode":
        action = distribution.mode
    else:
        # One generator for all: the same numbers for whatever is seen, so that only that differs.
        generator = Streams(0, "look").generator(device=seen.device)
        shape = torch.Size([1, *distribution.batch_shape, *distribution.event_shape])
        action = draw(distribution, uniform_noise(shape, 1, [generator], seen.device)[0, 0])
    generators = [Streams(0, "look", k).generator(device=seen.device) for k in range(SAMPLES)]
    choices = frozen.proposals.draw(action, problems, generators)
    return choices.flatten().bincount(minlength=frozen.proposals.choices) / choices.numel()


def _row(
    task: MazeTask, stage: Stage, what: str, shares: Tensor, reference: Tensor
) -> dict[str, Any]:
    fractions, lengths = task.space.decode(torch.arange(task.space.size, device=shares.device))
    return {
        "updates": stage.updates,
        "return": float(stage.seen["validation_return"]),
        "seen": what,
        "obstacle_fraction": float(shares @ fractions.to(shares.dtype)),
        "path_length": float(shares @ lengths.to(shares.dtype)),
        "distance": float((shares - reference).abs().sum() / 2),
        "distance_from_even": float((shares - 1 / task.space.size).abs().sum() / 2),
        "shares": shares.unflatten(0, task.space.shape).tolist(),
    }


def _print(rows: list[dict[str, Any]]) -> None:
    table = Table(
        "updates", "measured", "seen of the Solver", "fraction", "length", "changed", "from even",
        caption="Mean obstacle fraction and path length of the proposals; distances are total "
        "variation: from the proposals to the Solver as it is, and from the even mixture.",
    )  # fmt: skip
    for row in rows:
        numbers = ("obstacle_fraction", "path_length", "distance", "distance_from_even")
        table.add_row(
            str(row["updates"]), f"{row['return']:.3f}", row["seen"],
            *(f"{row[key]:.3f}" for key in numbers),
        )  # fmt: skip
    Console().print(table)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/look",
        description="Shows what a Proposer proposes to Solvers at several stages of training, and "
        "what changes when it is shown the probes or the return of another Solver. If nothing "
        "does, it does not look.",
        epilog="A run keeps a checkpoint of every stage with schedule.keep_checkpoints=1000.",
    )
    parser.add_argument("proposer", type=Path, help="folder of a run with a Proposer")
    parser.add_argument("solvers", type=Path, help="folder of a run; all its checkpoints are shown")
    parser.add_argument("--seed", type=int, default=0, help="of the levels it looks at (0)")
    parser.add_argument("--output", type=Path, help="a JSON file for the rows")
    return parser


if __name__ == "__main__":
    main()
