"""The signal-to-noise ratio of the Proposer's reward in a run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Dirichlet
from tqdm import tqdm

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import saved_config
from proposer_rl.cli.stored import checkpoints, write_rows
from proposer_rl.meta.actions import Actions, Mixture, ProblemChoices
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.rewards import log_success, performance_gain
from proposer_rl.meta.signal import by_validation_size, performance_around
from proposer_rl.meta.view import SolverView
from proposer_rl.runs.checkpoint import load_checkpoint
from proposer_rl.settings import MixtureSettings
from proposer_rl.streams import Streams
from proposer_rl.task import Task

UNEVEN = 0.15  # concentration of the Dirichlet distribution of uneven mixtures
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
    found = [(folder, file) for folder in arguments.folders for file in checkpoints(folder)]
    work = [(folder, file, name) for folder, file in found for name in arguments.explorations]
    rows = []
    for folder, file, name in tqdm(work, desc="explorations", disable=not sys.stderr.isatty()):
        rows += _measure(folder, file, name, arguments)
    return rows


def _measure(
    folder: Path, file: Path, exploration: str, arguments: argparse.Namespace
) -> list[dict[str, Any]]:
    config = saved_config(folder)
    task = make_task(config)
    step, state = load_checkpoint(file)
    solver = TensorDict(state["solver"], [len(config.seeds)])[0]
    length = arguments.meta_episode_length or config.proposer.meta_episode_length
    streams = Streams(arguments.seed, "snr", folder.name, step)
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
    drawn = draw(env.steps, arguments.proposals, streams.generator("actions"))
    levels = task.target.sample(max(arguments.levels), streams.generator("levels"))
    around = performance_around(
        env, solver, drawn.to(task.device), levels, streams.within(exploration)
    )
    return [
        {
            "run": folder.name,
            "updates": state["updates"],
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
# in T steps, [T, G, ...].
_Exploration = tuple[Actions, bool, Callable[[int, int, torch.Generator], Tensor]]


def _even(task: Task) -> _Exploration:
    mixture = Mixture(task.space, torch.eye(task.space.size))
    return mixture, True, lambda steps, groups, _: torch.zeros(steps, groups, mixture.bins)


def _problems(task: Task) -> _Exploration:
    choices = ProblemChoices(task.space)

    def draw(steps: int, groups: int, generator: torch.Generator) -> Tensor:
        shape = (steps, groups, task.batch_size)
        return torch.randint(choices.bins, shape, generator=generator)

    return choices, False, draw


def _mixture(task: Task) -> _Exploration:
    mixture = Mixture(task.space)

    def draw(steps: int, groups: int, generator: torch.Generator) -> Tensor:
        return SPREAD * torch.randn(steps, groups, len(mixture.directions), generator=generator)

    return mixture, True, draw


def _uneven(task: Task) -> _Exploration:
    mixture = Mixture(task.space, torch.eye(task.space.size))

    def draw(steps: int, groups: int, generator: torch.Generator) -> Tensor:
        # Torch's Dirichlet takes no generator: its default one draws from this one's stream.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator.initial_seed())
            shares = Dirichlet(torch.full((mixture.bins,), UNEVEN)).sample((steps, groups))
        return shares.clamp_min(1e-6).log()

    return mixture, True, draw


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
