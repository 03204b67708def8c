"""A task of seconds, and the Proposer's environment on it."""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from proposer_rl import recipes
from proposer_rl.cli.config import RunConfig, read_config
from proposer_rl.cli.groups import arranged
from proposer_rl.learning import PPO, PPOSettings, SolverSettings
from proposer_rl.models import ActorCritic, cell_logits
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task
from proposer_rl.tasks.batched_envs import BatchedTask
from proposer_rl.tasks.gymnasium.networks import NetworkSettings
from proposer_rl.tasks.mazes import Level, planes
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator
from proposer_rl.tasks.mazes.task import (
    DistributionSettings,
    MazeEvaluationSettings,
    MazeSettings,
    MazeTask,
    SpaceSettings,
    UNetSettings,
)
from proposer_rl.tasks.ranges import RangeSettings
from proposer_rl.tasks.view_mazes.task import ViewEvaluationSettings, ViewMazeSettings, ViewMazeTask
from proposer_rl.tasks.view_mazes.view_env import ViewNetworkSettings
from proposer_rl.tasks.view_mazes.view_levels import (
    PerfectSettings,
    ScatteredSettings,
    ViewSpaceSettings,
)

EXAMPLES = str(Path(__file__).parents[1] / "examples")
EVALUATE = ExactEvaluator(max_steps=8)


def tiny_task(**changed: Any) -> MazeTask:
    """5x5 mazes in four bins, of which the last one is the target."""
    ppo = PPOSettings(horizon=8, epochs=2, learning_rate=3e-3)
    parts: dict[str, Any] = {
        "maze": MazeSettings(height=5, width=5, max_steps=8),
        "distributions": {"id": DistributionSettings(specifications=[(0.2, 4)])},
        "target": "id",
        "space": SpaceSettings(obstacle_fractions=[0.0, 0.2], path_lengths=[2, 4]),
        "network": UNetSettings(channels=[8, 8], groups=4),
        "encoder_channels": [8, 8],
        "evaluation": MazeEvaluationSettings(distributions=["id"], levels=8),
        "solver": SolverSettings(batch_size=4, ppo=ppo),
        "context": ComputeContext(),
    }
    return MazeTask(**{**parts, **changed})


TASK = tiny_task()


def example_task(module: str, name: str) -> Task:
    """A task of an example, which is imported as a script in its folder would import it."""
    sys.path.insert(0, EXAMPLES)
    try:
        make = getattr(import_module(module), name)
    finally:
        sys.path.remove(EXAMPLES)
    solver = SolverSettings(batch_size=4, ppo=PPOSettings(horizon=8, epochs=2))
    return make(levels=8, solver=solver, context=ComputeContext())


mountain_cars = partial(example_task, "mountain_car", "MountainCarTask")
sledges = partial(example_task, "own_task", "SledgeTask")


def point_masses(**changed: Any) -> BatchedTask:
    """SPDL's gates, in 8 x 5 x 2 bins, before which episodes are short."""
    position = {"distribution": "norm", "loc": 2.5, "scale": 0.004}
    parts: dict[str, Any] = dict(
        env="proposer_rl.tasks.point_masses.PointMassEnv",
        max_steps=8,
        seeded=False,
        parameters=dict(
            position=RangeSettings(low=-4.0, high=4.0, bins=8, target=position),
            width=RangeSettings(low=0.5, high=8.0, bins=5, target=0.5),
            friction=RangeSettings(low=0.0, high=4.0, bins=2, target=0.0),
        ),
        network=NetworkSettings(hidden=[8], scale=0.25),
        levels=8,
        solver=SolverSettings(batch_size=4, ppo=PPOSettings(horizon=8, epochs=2)),
        context=ComputeContext(),
    )
    return BatchedTask(**{**parts, **changed})


def tiny_view_task(**changed: Any) -> ViewMazeTask:
    """5x5 mazes that Solvers with memory see through a window, in four bins."""
    kind = ScatteredSettings(fewest=5, most=5, solvable=True)
    parts: dict[str, Any] = dict(
        maze=ViewMazeSettings(height=5, width=5, max_steps=8),
        distributions={"id": kind, "ood": PerfectSettings()},
        target="id",
        space=ViewSpaceSettings(walls=[0, 5], path_lengths=[2, 4]),
        network=ViewNetworkSettings(channels=4, memory=8, head=8),
        encoder_channels=[8, 8],
        evaluation=ViewEvaluationSettings(distributions=["id", "ood"], levels=8, named_episodes=6),
        solver=SolverSettings(
            batch_size=4, ppo=PPOSettings(horizon=8, epochs=2, learning_rate=3e-3)
        ),
        context=ComputeContext(),
    )
    return ViewMazeTask(**{**parts, **changed})


def learners(copies: int) -> PPO:
    """As many copies of one Solver, the same in every call."""
    return TASK.learner([Streams(0, "solver")] * copies)


def evaluate(agent: ActorCritic, levels: Level) -> TensorDictBase:
    """What K Solvers reach on levels [E], without the task."""
    copies = levels.expand(agent.copies, *levels.batch_size)
    with torch.no_grad():
        return EVALUATE(copies, cell_logits(agent, planes(copies)))


def composed(*overrides: str) -> RunConfig:
    """The settings that the command gets."""
    return read_config(recipes.composed(arranged(overrides)))
