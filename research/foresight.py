"""How far ahead first-order gain predicts what training brings.

From every checkpoint, replicas of the Solver train on different mixtures, and their gains on the
target after some updates are compared with those predicted without any training.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table
from scipy.stats import bootstrap, linregress, rankdata
from torch import Tensor

from proposer_rl.cli.build import Stage, StoredRun
from proposer_rl.cli.errors import ConfigError, number
from proposer_rl.learning import PPO
from proposer_rl.meta.actions import Mixture
from proposer_rl.meta.env import SolverTrainingEnv, SolverView
from proposer_rl.meta.first_order import bin_scores, exact_alignment, exact_direction
from proposer_rl.meta.rewards import log_success, log_success_gain
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask
from research.common import Rows, answer, checkpoints, parser_of
from research.signal import performance_at, uneven_shares

CANDIDATES = 32  # levels of each bin that are scored


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    answer(_parser().parse_args(arguments), _rows, _table)


def _rows(options: argparse.Namespace) -> Rows:
    return [row for one in checkpoints(options.folders) for row in _measure(*one, options)]


def _measure(run: StoredRun, stage: Stage, options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for every number of updates ahead of a checkpoint."""
    task = run.task
    if not isinstance(task, DifferentiableTask):
        raise ConfigError(
            f"first-order gain needs gradients: {type(task).__name__} must define "
            "differentiable_performance(agent, levels)"
        )
    streams = Streams(options.seed, "foresight", run.folder.name, stage.step)
    levels = task.target.sample(options.levels, streams.generator("levels"))
    learner = task.learner([Streams(0)])
    learner.restore(stage.solver)
    with streams.as_default("mixtures"):
        shares = uneven_shares((options.proposals,), task.space.size)
    shares = shares / shares.sum(-1, keepdim=True)
    predicted = (shares @ _scores(task, learner, levels, streams)).numpy()  # [G]
    ahead = sorted(set(options.ahead))
    env = SolverTrainingEnv(
        task.learner([Streams(0)] * options.proposals * options.copies),
        view=SolverView(task, validation_levels=1, probe_levels=0),
        actions=Mixture(task.space, torch.eye(task.space.size)),
        reward=log_success_gain,
        meta_episode_length=ahead[-1],
        action_repeat=1,
    )
    actions = shares.log().expand(ahead[-1], -1, -1).to(task.device)
    before, *after = performance_at([0, *ahead], env, stage.solver[0], actions, levels, streams)
    for updates, performance in zip(ahead, after, strict=True):
        gains = log_success(performance).mean(-1) - log_success(before).mean(-1)  # [G, R]
        measured = gains.mean(1).cpu().numpy()
        yield {
            "run": run.folder.name,
            "updates": stage.updates,
            "ahead": updates,
            "proposals": options.proposals,
            "copies": options.copies,
            **agreement(predicted, measured),
        }


def _scores(task: Any, learner: PPO, target: Any, streams: Streams) -> Tensor:
    """First-order score of every bin, float [N]."""
    _, direction = exact_direction(task, learner, target.unsqueeze(0), "log_success")
    bins = torch.arange(task.space.size).repeat_interleave(CANDIDATES).unsqueeze(0)
    levels = task.space.generate(bins, [streams.generator("candidates")])
    found = exact_alignment(task, learner, direction, levels)
    return bin_scores(found.unflatten(-1, (task.space.size, CANDIDATES)))[0][0].cpu()


def agreement(predicted: np.ndarray, measured: np.ndarray) -> dict[str, float]:
    """How well predicted gains agree with measured ones, both [G].

    Returns:
        ``rank``, Spearman's correlation with its 95 % interval ``low`` and ``high`` (bias-corrected
        bootstrap over the proposals); ``slope``, the measured gain for each unit of the predicted
        one, with its standard error; ``explained``, the share of the variance that a line explains.

    Raises:
        ValueError: for fewer than four proposals.
    """
    if len(predicted) < 4:
        raise ValueError(f"at least 4 proposals are needed, got {len(predicted)}")
    rank = float(_rank_correlation(predicted, measured))
    interval = bootstrap(
        (predicted, measured),
        _rank_correlation,
        paired=True,
        vectorized=True,
        n_resamples=2000,
        rng=np.random.default_rng(0),
    ).confidence_interval
    line = linregress(predicted, measured)
    return {
        "rank": rank,
        "low": float(interval.low),
        "high": float(interval.high),
        "slope": float(line.slope),
        "slope_error": float(line.stderr),
        "explained": float(line.rvalue**2),
        "gain_sd": float(measured.std(ddof=1)),
    }


def _rank_correlation(x: np.ndarray, y: np.ndarray, axis: int = -1) -> np.ndarray:
    """Spearman's, along an axis: the correlation of ranks; 0 where all are alike."""
    x, y = (rankdata(values, axis=axis) for values in (x, y))
    x, y = (values - values.mean(axis, keepdims=True) for values in (x, y))
    spread = np.sqrt((x**2).sum(axis) * (y**2).sum(axis))
    return (x * y).sum(axis) / np.where(spread > 0, spread, np.inf)


def _table(run: str, rows: Rows) -> Table:
    table = Table(
        "updates", "ahead", "rank correlation", "95 %", "slope", "explained", "sd of gains",
        title=f"{run}: predicted and measured gain of mixtures",
        caption="gain in log success on the target; slope: measured for each predicted unit",
    )  # fmt: skip
    for row in rows:
        table.add_row(
            str(row["updates"]), str(row["ahead"]), f"{row['rank']:.2f}",
            f"{row['low']:.2f} to {row['high']:.2f}",
            f"{row['slope']:.3g} ± {row['slope_error']:.2g}",
            f"{row['explained']:.0%}", f"{row['gain_sd']:.3f}",
        )  # fmt: skip
    return table


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(
        "foresight", "Compares first-order gain with what training brings.", "all draws"
    )
    parser.add_argument("folders", nargs="+", type=Path, help="folders of runs")
    parser.add_argument(
        "--ahead", type=number(int, 1), nargs="+", default=[1, 5, 20, 50],
        help="numbers of updates after which gains are measured (1 5 20 50)",
    )  # fmt: skip
    parser.add_argument(
        "--proposals", type=number(int, 4), default=16, help="different mixtures (16)"
    )
    parser.add_argument("--copies", type=number(int, 1), default=2, help="replicas of each (2)")
    parser.add_argument("--levels", type=number(int, 1), default=512, help="of the target (512)")
    return parser


if __name__ == "__main__":
    main()
