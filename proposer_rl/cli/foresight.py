"""How far ahead does first-order gain look?"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.stats import bootstrap, linregress, rankdata
from torch import Tensor
from tqdm import tqdm

from proposer_rl.cli.config import ConfigError
from proposer_rl.cli.stored import Stage, StoredRun, stored_run, write_rows
from proposer_rl.learning import PPO
from proposer_rl.meta.actions import Mixture
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.first_order import bin_scores, exact_alignment, exact_direction
from proposer_rl.meta.rewards import log_success, log_success_gain
from proposer_rl.meta.signal import performance_at, uneven_shares
from proposer_rl.meta.view import SolverView
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask

CANDIDATES = 32  # levels of each bin that are scored


def run(arguments: argparse.Namespace) -> None:
    """Measure, print and write what ``bin/foresight`` was asked."""
    runs = [stored_run(folder) for folder in arguments.folders]
    for run in runs:
        if not isinstance(run.task, DifferentiableTask):
            raise ConfigError(
                f"first-order gain needs gradients: {type(run.task).__name__} must define "
                "differentiable_performance(agent, levels)"
            )
    found = [(run, file) for run in runs for file in run.files]
    rows: list[dict[str, Any]] = []
    for run, file in tqdm(found, desc="checkpoints", disable=not sys.stderr.isatty()):
        rows += _measure(run, run.stage(file), arguments)
    _print(rows)
    write_rows(rows, arguments.output)


def _measure(
    run: StoredRun, stage: Stage, arguments: argparse.Namespace
) -> Iterator[dict[str, Any]]:
    """A row for every number of updates ahead of a checkpoint."""
    task = run.task
    streams = Streams(arguments.seed, "foresight", run.folder.name, stage.step)
    levels = task.target.sample(arguments.levels, streams.generator("levels"))
    learner = task.learner([Streams(0)])
    learner.restore(stage.solver)
    with streams.as_default("mixtures"):
        shares = uneven_shares((arguments.proposals,), task.space.size)
    shares = shares / shares.sum(-1, keepdim=True)
    predicted = (shares @ _scores(task, learner, levels, streams)).numpy()  # [G]
    ahead = sorted(set(arguments.ahead))
    env = SolverTrainingEnv(
        task.learner([Streams(0)] * arguments.proposals * arguments.copies),
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
            "proposals": arguments.proposals,
            "copies": arguments.copies,
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
    """How well predicted gains tell measured ones, both [G].

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


def _print(rows: list[dict[str, Any]]) -> None:
    for run in dict.fromkeys(row["run"] for row in rows):
        table = Table(
            "updates", "ahead", "rank correlation", "95 %", "slope", "explained", "sd of gains",
            title=f"{run}: predicted and measured gain of mixtures",
            caption="gain in log success on the target; slope: measured for each predicted unit",
        )  # fmt: skip
        for row in (row for row in rows if row["run"] == run):
            table.add_row(
                str(row["updates"]), str(row["ahead"]), f"{row['rank']:.2f}",
                f"{row['low']:.2f} to {row['high']:.2f}",
                f"{row['slope']:.3g} ± {row['slope_error']:.2g}",
                f"{row['explained']:.0%}", f"{row['gain_sd']:.3f}",
            )  # fmt: skip
        Console().print(table)
