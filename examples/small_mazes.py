"""Helpers of the examples on mazes: a task that trains in seconds, and a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from torch import nn

from proposer_rl import (
    PPO,
    ComputeContext,
    Curriculum,
    Experiment,
    PPOSettings,
    ScheduleSettings,
    SolverSettings,
    Streams,
)
from proposer_rl.learning import LearningSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.runs.folder import RunFolder, read_csv
from proposer_rl.tasks.mazes.task import (
    DistributionSettings,
    MazeEvaluationSettings,
    MazeSettings,
    MazeTask,
    SpaceSettings,
    UNetSettings,
)

CYCLE = 10  # updates between two improvements of a curriculum


def small_task(network: Callable[[], nn.Module] | None = None) -> MazeTask:
    """Make a task of 5x5 mazes; the target has 5 obstacles and paths of 4 moves."""
    ppo = PPOSettings(horizon=10, learning_rate=2e-3)
    return MazeTask(
        maze=MazeSettings(height=5, width=5, max_steps=10),
        distributions={"id": DistributionSettings(specifications=[(0.2, 4)])},
        target="id",
        space=SpaceSettings(obstacle_fractions=[0.0, 0.2, 0.4], path_lengths=[1, 2, 4, 6]),
        network=UNetSettings(channels=[16, 32]),
        encoder_channels=[8, 16],
        evaluation=MazeEvaluationSettings(distributions=["id"], levels=128),
        solver=SolverSettings(batch_size=32, ppo=ppo),
        context=ComputeContext(),
        make_network=network,
    )


def proposer_settings() -> ProposerSettings:
    """Return settings of a Proposer that learns from four replicas of the Solver."""
    return ProposerSettings(
        rollouts=4,
        meta_episode_length=CYCLE,
        action_repeat=CYCLE,
        validation_levels=64,
        probe_levels=4,
        ppo=LearningSettings(gamma=1.0, learning_rate=1e-3),
    )


def train(
    task: MazeTask, curriculum: Curriculum, updates: int, learner: PPO | None = None
) -> list[dict[str, Any]]:
    """Train a Solver, new unless given; return a row of measurements for every ten updates."""
    with TemporaryDirectory() as folder:
        experiment = Experiment(
            task,
            learner or task.learner([Streams(0, "solver")]),
            [curriculum],
            schedule=ScheduleSettings(updates=updates, cycle_length=CYCLE, evaluate_every=CYCLE),
            seeds=[0],
            folder=RunFolder(Path(folder)),
            progress=False,
        )
        experiment.run()
        return read_csv(Path(folder) / "metrics.csv")


def report(rows: list[dict[str, Any]]) -> None:
    """Print success on the target along training."""
    for row in rows:
        print(f"{row['updates']:4.0f} updates: success {row['id_success']:.3f}")
