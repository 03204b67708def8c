"""The signal-to-noise ratio of the Proposer's reward in a run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDictBase
from torch import Tensor
from tqdm import tqdm

from proposer_rl.cli.stored import Stage, StoredRun, stored_run, write_rows
from proposer_rl.meta.actions import Actions, Mixture, ProblemChoices
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.rewards import log_success, performance_gain
from proposer_rl.meta.signal import by_validation_size, performance_around, uneven_shares
from proposer_rl.meta.view import SolverView
from proposer_rl.settings import MixtureSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Task

SPREAD = MixtureSettings().spread  # of a Proposer's first policy over mixtures
MEASURES: dict[str, Callable[[Any], Tensor]] = {
    "return": lambda performance: performance["return"],
    "log_success": log_success,
}


def run(arguments: argparse.Namespace) -> None:
    """Measure, print and write what ``bin/snr`` was asked."""
    rows = measure(arguments)
    _print(rows)
    write_rows(rows, arguments.output)


def measure(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for every checkpoint, exploration, measure and validation size.

    Raises:
        ConfigError, CheckpointError: if a folder is no run's, or a checkpoint cannot be read.
        ValueError: if a number is out of range.
    """
    runs = [stored_run(folder) for folder in arguments.folders]
    found = [(run, file) for run in runs for file in run.files]
    work = [(run, file, name) for run, file in found for name in arguments.explorations]
    rows = []
    for run, file, name in tqdm(work, desc="explorations", disable=not sys.stderr.isatty()):
        rows += _measure(run, run.stage(file), name, arguments)
    return rows


def _measure(
    run: StoredRun, stage: Stage, exploration: str, arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    task = run.task
    length = arguments.meta_episode_length or run.config.proposer.meta_episode_length
    streams = Streams(arguments.seed, "snr", run.folder.name, stage.step)
    actions, held, draw = EXPLORATIONS[exploration](task)
    env = SolverTrainingEnv(
        task.learner([Streams(0)] * arguments.proposals * arguments.copies),
        # The gain is measured around the episode only, so next to nothing is at every step.
        view=SolverView(task, validation_levels=1, probe_levels=0),
        actions=actions,
        reward=performance_gain,
        meta_episode_length=length,
        action_repeat=length if held else 1,
    )
    with streams.as_default("actions"):
        drawn = draw(env.steps, arguments.proposals)
    levels = task.target.sample(max(arguments.levels), streams.generator("levels"))
    around = performance_around(
        env, stage.solver[0], drawn.to(task.device), levels, streams.within(exploration)
    )
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
        for name in arguments.measures or _told(around[0])
        for before, after in [tuple(MEASURES[name](performance).cpu() for performance in around)]
        for size, signal in by_validation_size(after - before, arguments.levels).items()
    ]


def _told(performance: TensorDictBase) -> list[str]:
    return [name for name in MEASURES if name == "return" or "success" in performance.keys()]


# The meaning of actions, whether one holds for the episode, and how to draw those of G proposals
# in T steps, [T, G, ...], from torch's default generator.
_Exploration = tuple[Actions, bool, Callable[[int, int], Tensor]]


def _even(task: Task) -> _Exploration:
    mixture = Mixture(task.space, torch.eye(task.space.size))
    return mixture, True, lambda steps, groups: torch.zeros(steps, groups, mixture.bins)


def _problems(task: Task) -> _Exploration:
    choices, count = ProblemChoices(task.space), task.batch_size
    return choices, False, lambda *shape: torch.randint(choices.bins, (*shape, count))


def _mixture(task: Task) -> _Exploration:
    mixture = Mixture(task.space)
    return mixture, True, lambda *shape: SPREAD * torch.randn(*shape, len(mixture.directions))


def _uneven(task: Task) -> _Exploration:
    mixture = Mixture(task.space, torch.eye(task.space.size))
    return mixture, True, lambda *shape: uneven_shares(shape, mixture.bins).log()


# cli/instruments.py says what each is.
EXPLORATIONS = {"even": _even, "problems": _problems, "mixture": _mixture, "uneven": _uneven}


def _print(rows: list[dict[str, Any]]) -> None:
    for run in dict.fromkeys(row["run"] for row in rows):
        own = [row for row in rows if row["run"] == run]
        table = Table(
            "updates", "exploration", "measure", "levels",
            "mean gain", "noise", "signal", "ratio", "95 %",
            title=f"{run}: total gain over {own[0]['meta_episode_length']} updates",
            caption="noise, signal: standard deviations within and between proposals; "
            "ratio: of their squares, with its confidence interval",
        )  # fmt: skip
        for row in own:
            table.add_row(
                str(row["updates"]), row["exploration"], row["measure"], str(row["levels"]),
                *(f"{row[key]:.4f}" for key in ("mean", "noise", "signal")),
                f"{row['ratio']:.2f}", f"{row['low']:.2f} - {row['high']:.2f}",
            )  # fmt: skip
        Console().print(table)
