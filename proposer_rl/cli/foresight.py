"""How far ahead does first-order gain look?"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from scipy.stats import bootstrap, linregress, rankdata
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Dirichlet
from tqdm import tqdm

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import ConfigError, saved_config
from proposer_rl.cli.stored import checkpoints, write_rows
from proposer_rl.curricula import require_gradients
from proposer_rl.learning import PPO
from proposer_rl.meta.actions import Mixture
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.first_order import bin_scores, exact_alignment, exact_direction
from proposer_rl.meta.rewards import log_success, log_success_gain
from proposer_rl.meta.signal import performance_at
from proposer_rl.meta.view import SolverView
from proposer_rl.runs.checkpoint import load_checkpoint
from proposer_rl.streams import Streams

CONCENTRATION = 0.15  # of the Dirichlet distribution of the mixtures that are trained on
CANDIDATES = 32  # levels of each bin that are scored


def run(arguments: argparse.Namespace) -> None:
    """Measure, print and write what ``bin/foresight`` was asked."""
    found = [(folder, file) for folder in arguments.folders for file in checkpoints(folder)]
    rows: list[dict[str, Any]] = []
    for folder, file in tqdm(found, desc="checkpoints", disable=not sys.stderr.isatty()):
        rows += _measure(folder, file, arguments)
    _print(rows)
    write_rows(rows, arguments.output)


def _measure(folder: Path, file: Path, arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for every number of updates ahead of a checkpoint."""
    config = saved_config(folder)
    task = make_task(config)
    try:
        require_gradients(task)
    except TypeError as error:
        raise ConfigError(str(error)) from error
    step, state = load_checkpoint(file)
    solver = TensorDict(state["solver"], [len(config.seeds)])[:1]
    streams = Streams(arguments.seed, "foresight", folder.name, step)
    levels = task.target.sample(arguments.levels, streams.generator("levels"))
    learner = task.learner([Streams(0)])
    learner.restore(solver)
    shares = _mixtures(arguments.proposals, task.space.size, streams.generator("mixtures"))
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
    before, *after = performance_at([0, *ahead], env, solver[0], actions, levels, streams)
    for updates, performance in zip(ahead, after, strict=True):
        gains = log_success(performance).mean(-1) - log_success(before).mean(-1)  # [G, R]
        measured = gains.mean(1).cpu().numpy()
        yield {
            "run": folder.name,
            "updates": state["updates"],
            "ahead": updates,
            "proposals": arguments.proposals,
            "copies": arguments.copies,
            **agreement(predicted, measured),
        }


def _mixtures(count: int, bins: int, generator: torch.Generator) -> Tensor:
    # Torch's Dirichlet takes no generator: its default one draws from this one's stream.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(generator.initial_seed())
        shares = Dirichlet(torch.full((bins,), CONCENTRATION)).sample((count,))
    shares = shares.clamp_min(1e-6)
    return shares / shares.sum(-1, keepdim=True)


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
