"""The sizes that are measured: ``conf/train.yaml`` and ``conf/scale`` (a test compares them)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import cycle

import torch

from benchmarks.results import Options
from proposer_rl.learning.ppo import PPO, PPOSettings
from proposer_rl.mazes import Level
from proposer_rl.mazes.task import (
    DistributionSettings,
    EvaluationSettings,
    MazeSettings,
    MazeTask,
    SolverSettings,
    SpaceSettings,
    faster_precision,
)
from proposer_rl.methods import ProposerSettings
from proposer_rl.streams import Streams

NARROW = [16, 32, 32]


@dataclass(frozen=True)
class Scale:
    """The settings of a run, without its schedule; ``threads`` None leaves torch's choice."""

    maze: MazeSettings
    distributions: dict[str, DistributionSettings]
    space: SpaceSettings
    solver: SolverSettings
    proposer: ProposerSettings
    threads: int | None = None

    def with_solver(
        self, *, channels: list[int] | None = None, problems: int | None = None
    ) -> Scale:
        """The same with another network or number of levels per update."""
        solver = replace(
            self.solver,
            channels=channels or self.solver.channels,
            problems=problems or self.solver.problems,
        )
        return replace(self, solver=solver)

    def with_copies(self, copies: int) -> Scale:
        """The same with another number of parallel Solvers."""
        return replace(self, proposer=replace(self.proposer, rollouts=copies))

    def precision(self, options: Options) -> str:
        """The precision asked for; with ``auto`` that of a run."""
        if options.precision != "auto":
            return options.precision
        return faster_precision(self.solver.channels, torch.device(options.device))

    def task(self, options: Options, precision: str | None = None, graphs: bool = True) -> MazeTask:
        """The maze task of these settings."""
        return MazeTask(
            maze=self.maze,
            distributions=self.distributions,
            target="id",
            space=self.space,
            solver=self.solver,
            # Of no account here, so few.
            evaluation=EvaluationSettings(distributions=["id"], levels=8),
            device=options.device,
            precision=precision or self.precision(options),
            graphs=graphs,
        )


PAPER = Scale(
    maze=MazeSettings(),
    distributions={
        "id": DistributionSettings(specifications=[(0.4, 12)]),
        "ood": DistributionSettings(specifications=[(0.5, 14)], mechanism="path_first"),
    },
    space=SpaceSettings(
        obstacle_fractions=[0.0, 0.1, 0.2, 0.3, 0.4, 0.5],
        path_lengths=[2, 4, 6, 8, 10, 12, 14, 16],
    ),
    solver=SolverSettings(channels=[64, 128, 256]),
    proposer=ProposerSettings(
        channels=[32, 64], ppo=PPOSettings(horizon=50, updates=3, epochs=16, gamma=1.0)
    ),
)

_QUICK_PPO = PPOSettings(horizon=15, learning_rate=1e-3)
QUICK = Scale(
    maze=MazeSettings(height=6, width=6, max_steps=15),
    distributions={
        "id": DistributionSettings(specifications=[(0.4, 8)]),
        "ood": DistributionSettings(specifications=[(0.5, 10)], mechanism="path_first"),
    },
    space=SpaceSettings(obstacle_fractions=[0.0, 0.2, 0.4, 0.5], path_lengths=[2, 4, 6, 8, 10]),
    solver=SolverSettings(channels=[16, 32], problems=32, ppo=_QUICK_PPO),
    proposer=replace(
        PAPER.proposer,
        rollouts=8,
        lookahead=20,
        updates_per_step=20,
        context=64,
        hidden=64,
        channels=[16, 32],
        ppo=replace(PAPER.proposer.ppo, horizon=20, learning_rate=1e-3),
    ),
    threads=1,
)

_TINY_PPO = PPOSettings(horizon=10, epochs=2)
TINY = Scale(
    maze=MazeSettings(height=5, width=5, max_steps=10),
    distributions={
        "id": DistributionSettings(specifications=[(0.2, 4)]),
        "ood": DistributionSettings(specifications=[(0.3, 5)], mechanism="path_first"),
    },
    space=SpaceSettings(obstacle_fractions=[0.0, 0.2], path_lengths=[2, 4]),
    solver=SolverSettings(channels=[8, 8, 8], groups=4, problems=4, ppo=_TINY_PPO),
    proposer=ProposerSettings(
        rollouts=2,
        lookahead=3,
        updates_per_step=3,
        validation_levels=16,
        probe_levels=2,
        context=8,
        hidden=8,
        channels=[8, 8],
        ppo=PPOSettings(horizon=3, epochs=2, gamma=1.0),
    ),
)


def bf16_in_hardware(device: str) -> bool:
    """Whether bf16 is more than emulated."""
    if torch.device(device).type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


class Solvers:
    """A population with levels to train on: what a benchmark calls.

    Args:
        task: mazes and settings.
        copies: number of Solvers K.
        batches: different batches of levels, drawn beforehand and used in turn.
    """

    def __init__(self, task: MazeTask, copies: int = 1, batches: int = 3) -> None:
        self.task = task
        self.copies = copies
        self.ppo: PPO = task.solvers([Streams(copy, "solver") for copy in range(copies)])
        self._generators = [
            Streams(copy, "actions").generator(device=task.device) for copy in range(copies)
        ]
        self._levels: Iterator[Level] = cycle([self._draw(batch) for batch in range(batches)])

    def update(self) -> None:
        """One PPO update on new levels."""
        self.next_levels()
        self.ppo.update(self._generators)

    def next_levels(self) -> None:
        """Give the environment its next levels."""
        self.ppo.env.set_levels(next(self._levels))

    def _draw(self, batch: int) -> Level:
        shape = torch.Size([self.copies, self.task.solver.problems])
        generator = Streams(batch, "levels").generator()
        levels = self.task.sample_target(shape.numel(), generator)
        return levels.reshape(shape)
