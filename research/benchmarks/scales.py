"""The sizes that are measured: those of ``conf/``, composed and made as for a run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any

import torch

from proposer_rl import recipes
from proposer_rl.cli.build import Made, build, make_task, parts
from proposer_rl.cli.config import RunConfig, read_config
from proposer_rl.cli.groups import arranged
from proposer_rl.learning import PPO
from proposer_rl.runs.folder import RunFolder, read_csv
from proposer_rl.runs.process import StopSignals
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import Level
from proposer_rl.tasks.mazes.task import MazeTask
from research.benchmarks.results import Options


@dataclass(frozen=True)
class Scale:
    """The settings of a run: a file of ``conf/scale``, a method, and what else is overridden."""

    name: str
    method: str = "perf_gain"
    overrides: tuple[str, ...] = ()

    def but(self, *overrides: str) -> Scale:
        """The same with further overrides."""
        return replace(self, overrides=(*self.overrides, *overrides))

    @property
    def config(self) -> RunConfig:
        """The settings, checked."""
        return composed(f"+method={self.method}", f"+scale={self.name}", *self.overrides)

    @property
    def threads(self) -> int | None:
        """Of torch for one operation; None leaves torch's choice."""
        return self.config.compute.threads

    @property
    def channels(self) -> list[int]:
        """Of the Solver's network."""
        return list(self.config.task["network"]["channels"])

    def task(self, options: Options, *overrides: str) -> MazeTask:
        """The task of these settings."""
        task: Any = make_task(self._placed(options, overrides))
        return task

    def made(self, options: Options, *overrides: str) -> Made:
        """Task, Solver and curriculum of these settings."""
        return parts(self._placed(options, overrides), StopSignals())

    def run(self, options: Options, made: Made, *overrides: str) -> list[dict[str, Any]]:
        """A run from beginning to end, in a folder of its own; returns the rows of its metrics."""
        with tempfile.TemporaryDirectory() as folder:
            build(self._placed(options, overrides), made, RunFolder(folder)).run()
            return list(read_csv(Path(folder) / "metrics.csv"))

    def _placed(self, options: Options, overrides: tuple[str, ...]) -> RunConfig:
        # Threads are set around what is timed, and are this process's own again after it.
        compute = ["threads=null", "progress=false", f"device={options.device}"]
        placed = [f"precision={options.precision}", *(f"compute.{value}" for value in compute)]
        return self.but(*placed, *overrides).config


PAPER = Scale("paper")
QUICK = Scale("quick")
TINY = Scale("smoke")
NARROW = "task.network.channels=[16,32,32]"


def paper(options: Options) -> Scale:
    """The paper's values, unless the code is only to be tried."""
    return TINY if options.tiny else PAPER


def precisions(options: Options) -> list[str]:
    """Those that are compared: bf16 only where it is more than emulated."""
    return ["fp32", "bf16"] if bf16_in_hardware(options.device) else ["fp32"]


def bf16_in_hardware(device: str) -> bool:
    """Whether bf16 is more than emulated."""
    if torch.device(device).type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported()  # those with AMX have it, too


class Solvers:
    """A population with levels to train on: what a benchmark calls.

    Args:
        task: mazes and settings.
        copies: number of Solvers K.
        batches: different batches of levels, drawn beforehand and used in turn.
    """

    def __init__(self, task: MazeTask, copies: int = 1, batches: int = 3) -> None:
        self.ppo: PPO = task.learner([Streams(copy, "solver") for copy in range(copies)])
        self._generators = [Streams(copy, "actions").generator() for copy in range(copies)]
        shape = torch.Size([copies, task.batch_size])
        drawn = [
            task.target.sample(shape.numel(), Streams(batch, "levels").generator()).reshape(shape)
            for batch in range(batches)
        ]
        self._levels: Iterator[Level] = cycle(drawn)

    def update(self) -> None:
        """One PPO update on new levels."""
        self.next_levels()
        self.ppo.update(self._generators)

    def next_levels(self) -> None:
        """Give the environment its next levels."""
        self.ppo.env.set_levels(next(self._levels))


@cache
def composed(*overrides: str) -> RunConfig:
    """The settings of a command line, checked."""
    return read_config(recipes.composed(arranged(overrides)))
