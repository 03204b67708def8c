"""How much of a bin's first-order credit single episodes tell.

From every checkpoint, the alignment of every bin is estimated from episodes on it: along the exact
direction of the target, and along those of episodes on the target and on the interim target. An
analysis of variance splits the episodes' alignments into what is between bins and what is within
(:mod:`research.signal`).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from scipy.stats import spearmanr
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.cli.errors import ConfigError, number
from proposer_rl.cli.stored import Stage, StoredRun
from proposer_rl.curricula import TaskStudent
from proposer_rl.curricula.transport import interim_target, mastered, squared_distances
from proposer_rl.meta.first_order import Direction, exact_alignment, exact_direction, scaled
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask, Levels, LocatedTarget
from research.common import Rows, answer, checkpoints, parser_of
from research.signal import variance_components

DELTA = 0.2  # least success of the bins that the interim target lies on


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    answer(_parser().parse_args(arguments), _rows, _table)


def _rows(options: argparse.Namespace) -> Rows:
    return [row for one in checkpoints(options.folders) for row in _measure(*one, options)]


def _measure(run: StoredRun, stage: Stage, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for every direction, from a checkpoint."""
    task, size, each = run.task, run.task.space.size, options.each
    if not isinstance(task, DifferentiableTask) or not isinstance(task, LocatedTarget):
        raise ConfigError(
            f"exact credit needs gradients, and where the target lies: {type(task).__name__} must "
            "define differentiable_performance(agent, levels) and target_shares"
        )
    streams = Streams(options.seed, "credit", run.folder.name, stage.step)
    learner = task.learner([Streams(0)])
    learner.restore(stage.solver[:1])
    student = TaskStudent(task, learner)
    bins = torch.arange(size).repeat_interleave(each).unsqueeze(0)
    levels = task.space.generate(bins, [streams.generator("levels")])
    success = task.performance(learner.agent, levels, torch.Generator())["success"]
    success = success.unflatten(-1, (size, each)).mean(-1).cpu()
    target = task.target.sample(options.episodes, streams.generator("target")).unsqueeze(0)
    _, exact = exact_direction(task, learner, target, "log_success")
    aligned = exact_alignment(task, learner, exact, levels).unflatten(-1, (size, each))[0]
    interim = interim_target(
        task.target_shares.double(), squared_distances(task.space), mastered(success, DELTA)
    )
    generator = streams.generator("interim")
    drawn = torch.multinomial(interim, options.episodes, replacement=True, generator=generator)
    directions = {
        "exact": exact,
        "target": _sampled(student, target, streams.within("target")),
        "interim": _sampled(
            student, task.space.generate(drawn, [generator]), streams.within("interim")
        ),
    }
    episodes = [*_played(student, levels, streams.within("played"))]
    for name, direction in directions.items():
        parts: Any = torch.cat([student.sampled_alignment(direction, some) for some in episodes], 1)
        slopes = parts["slope"]
        if "drift" in parts.keys():  # as training standardises advantages; their unit is the same
            slopes = slopes - parts["advantage"].mean() * parts["drift"]
        found = slopes.unflatten(-1, (size, each))[0].cpu()
        signal = variance_components(found)
        yield {
            "run": run.folder.name,
            "updates": stage.updates,
            "direction": name,
            "cosine": _cosine(direction, exact),
            "between": signal.signal,
            "within": signal.noise,
            "ratio": signal.ratio,
            "rank": float(spearmanr(found.mean(-1), aligned.mean(-1).cpu()).statistic),
        }


def _played(student: TaskStudent, levels: Levels, streams: Streams) -> Iterator[TensorDictBase]:
    for i, some in enumerate(levels.split(student.batch_size, 1)):
        yield student.play(some, [streams.generator("actions", i)])


def _sampled(student: TaskStudent, levels: Levels, streams: Streams) -> Direction:
    """The policy gradient of an episode on each of the levels [1, n]."""
    total: dict[str, Tensor] = {}
    for rollout in _played(student, levels, streams):
        new = student.sampled_direction(rollout, torch.ones(rollout.shape[:2]))
        total = {name: total.get(name, 0.0) + entry for name, entry in new.items()}
    return scaled(total)


def _cosine(one: Direction, other: Direction) -> float:
    """Of two directions of root mean square 1."""
    numbers = sum(entry.numel() for entry in one.values())
    return sum(float((one[name] * other[name]).sum()) for name in one) / numbers


def _table(run: str, rows: Rows) -> Table:
    table = Table(
        "updates", "direction", "cosine", "between bins", "within", "episodes", "rank correlation",
        title=f"{run}: first-order credit from episodes",
        caption="standard deviations of alignments; episodes of a bin until half of the variance "
        "of its mean is between bins; rank correlation of all means with exact ones",
    )  # fmt: skip
    for row in rows:
        table.add_row(
            str(row["updates"]), row["direction"],
            *(f"{row[key]:.2f}" for key in ("cosine", "between", "within")),
            f"{1 / row['ratio']:.0f}" if row["ratio"] else "–", f"{row['rank']:.2f}",
        )  # fmt: skip
    return table


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("credit", "Measures how much of a bin's credit episodes tell.", "all draws")
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs")
    parser.add_argument(
        "--each", type=number(int, 2), default=64, help="episodes on every bin (64)"
    )
    parser.add_argument(
        "--episodes", type=number(int, 1), default=512, help="of which a direction is taken (512)"
    )
    return parser


if __name__ == "__main__":
    main()
