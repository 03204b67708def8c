"""The signal-to-noise ratio of the Proposer's reward in a run.

From every checkpoint, replicas of the Solver follow different proposals, several replicas each; an
analysis of variance splits their gains into signal and noise (:mod:`research.signal`).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from proposer_rl.cli.build import Stage, StoredRun
from proposer_rl.cli.errors import number
from proposer_rl.meta.actions import Actions, Mixture, ProblemChoices
from proposer_rl.meta.assembly import MixtureSettings
from proposer_rl.meta.env import SolverTrainingEnv, SolverView
from proposer_rl.meta.rewards import log_success, performance_gain
from proposer_rl.streams import Streams
from proposer_rl.task import Task
from research.common import Rows, answer, checkpoints, parser_of
from research.signal import by_validation_size, performance_at, uneven_shares

SPREAD = MixtureSettings().spread  # of a Proposer's first policy over mixtures
MEASURES: dict[str, Callable[[Any], Tensor]] = {
    "return": lambda performance: performance["return"],
    "log_success": log_success,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    answer(_parser().parse_args(arguments), _rows, _table)


def _rows(options: argparse.Namespace) -> Rows:
    """A row for every checkpoint, exploration, measure and validation size."""
    return [
        row
        for one in checkpoints(options.folders)
        for name in options.explorations
        for row in _measure(*one, name, options)
    ]


def _measure(run: StoredRun, stage: Stage, exploration: str, options: argparse.Namespace) -> Rows:
    task = run.task
    length = options.meta_episode_length or run.config.proposer.meta_episode_length
    streams = Streams(options.seed, "snr", run.folder.name, stage.step)
    actions, held, draw = EXPLORATIONS[exploration](task)
    env = SolverTrainingEnv(
        task.learner([Streams(0)] * options.proposals * options.copies),
        # The gain is measured around the episode only, so next to nothing is at every step.
        view=SolverView(task, validation_levels=1, probe_levels=0),
        actions=actions,
        reward=performance_gain,
        meta_episode_length=length,
        action_repeat=length if held else 1,
    )
    with streams.as_default("actions"):
        drawn = draw(env.steps, options.proposals).to(task.device)
    levels = task.target.sample(max(options.levels), streams.generator("levels"))
    steps = [0, len(drawn)]
    around = performance_at(steps, env, stage.solver[0], drawn, levels, streams.within(exploration))
    known = [name for name in MEASURES if name == "return" or "success" in around[0].keys()]
    return [
        {
            "run": run.folder.name,
            "updates": stage.updates,
            "exploration": exploration,
            "measure": name,
            "meta_episode_length": length,
            "levels": size,
            **asdict(signal),
        }
        for name in options.measures or known
        for before, after in [[MEASURES[name](performance).cpu() for performance in around]]
        for size, signal in by_validation_size(after - before, options.levels).items()
    ]


# The meaning of actions, whether one holds for the episode, and how to draw those of G proposals
# in T steps, [T, G, ...], from torch's default generator.
_Exploration = tuple[Actions, bool, Callable[[int, int], Tensor]]


def _even(task: Task) -> _Exploration:
    """All proposals are the uniform mixture: there is nothing to learn, the ratio must be 0."""
    mixture = Mixture(task.space, torch.eye(task.space.size))
    return mixture, True, lambda steps, groups: torch.zeros(steps, groups, mixture.bins)


def _problems(task: Task) -> _Exploration:
    """Every level's bin is drawn from one uniform policy (the paper's Proposer at its start)."""
    choices, count = ProblemChoices(task.space), task.batch_size
    return choices, False, lambda *shape: torch.randint(choices.bins, (*shape, count))


def _mixture(task: Task) -> _Exploration:
    """Mixtures as a Proposer draws them at first, held for the episode."""
    mixture = Mixture(task.space)
    return mixture, True, lambda *shape: SPREAD * torch.randn(*shape, len(mixture.directions))


def _uneven(task: Task) -> _Exploration:
    """Very uneven mixtures, Dirichlet(0.15) over all bins, held for the episode."""
    mixture = Mixture(task.space, torch.eye(task.space.size))
    return mixture, True, lambda *shape: uneven_shares(shape, mixture.bins).log()


def _show_explorations() -> str:
    return " ".join(f"{name}: {make.__doc__}" for name, make in EXPLORATIONS.items())


EXPLORATIONS: dict[str, Callable[[Task], _Exploration]] = {
    "even": _even,
    "problems": _problems,
    "mixture": _mixture,
    "uneven": _uneven,
}


def _table(run: str, rows: Rows) -> Table:
    table = Table(
        "updates", "exploration", "measure", "levels",
        "mean gain", "noise", "signal", "ratio", "95 %",
        title=f"{run}: total gain over {rows[0]['meta_episode_length']} updates",
        caption="noise, signal: standard deviations within and between proposals; "
        "ratio: of their squares, with its confidence interval",
    )  # fmt: skip
    for row in rows:
        table.add_row(
            str(row["updates"]), row["exploration"], row["measure"], str(row["levels"]),
            *(f"{row[key]:.4f}" for key in ("mean", "noise", "signal")),
            f"{row['ratio']:.2f}", f"{row['low']:.2f} - {row['high']:.2f}",
        )  # fmt: skip
    return table


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(
        "snr",
        "Measures how much of the Proposer's reward is due to what was proposed.",
        "all draws",
        f"Explorations: {_show_explorations()}",
    )
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs")
    parser.add_argument(
        "--meta-episode-length", type=number(int, 1), help="updates of an episode; the run's"
    )
    parser.add_argument(
        "--proposals", type=number(int, 2), default=8, help="different proposals (8)"
    )
    parser.add_argument("--copies", type=number(int, 2), default=3, help="replicas of each (3)")
    parser.add_argument(
        "--levels", type=number(int, 1), nargs="+", default=[75, 256, 1024],
        help="sizes of the validation batch (75 256 1024)",
    )  # fmt: skip
    parser.add_argument(
        "--explorations", nargs="+", default=list(EXPLORATIONS), choices=list(EXPLORATIONS),
        help="ways in which proposals differ (all)",
    )  # fmt: skip
    parser.add_argument(
        "--measures", nargs="+", choices=list(MEASURES),
        help="what gain is counted in (both, where the task has them)",
    )  # fmt: skip
    return parser


if __name__ == "__main__":
    main()
