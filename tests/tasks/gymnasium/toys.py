"""A small environment, whose step anybody can compute, and a task made of it."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from threading import Lock
from typing import Any

import gymnasium
import numpy as np
import pytest

from proposer_rl.learning import PPOSettings, SolverSettings
from proposer_rl.task import ComputeContext
from proposer_rl.tasks.gymnasium.environment import SuccessSettings
from proposer_rl.tasks.gymnasium.networks import NetworkSettings
from proposer_rl.tasks.gymnasium.player import ParameterSettings
from proposer_rl.tasks.gymnasium.task import EvaluationSettings, GymnasiumTask

WALK = "tests.tasks.gymnasium.toys:Walk-v0"
LIMIT = 6

# A run of any of these tasks in a second: no scale is theirs.
TINY = [
    "compute.progress=false", "task.max_steps=12", "task.evaluation.levels=4",
    "solver.batch_size=4", "solver.ppo.horizon=12", "solver.ppo.epochs=2", "schedule.updates=4",
    "solver.ppo.minibatches=2", "proposer.rollouts=2", "proposer.meta_episode_length=2",
    "proposer.action_repeat=2",
    "proposer.validation_levels=4", "proposer.probe_levels=2", "schedule.evaluate_every=2",
    "hand_designed.until=[2]", "pool.capacity=8", "pool.candidates=8", "pool.keep=4",
]  # fmt: skip


CHOICES = [  # an environment of several choices at once
    "task=gymnasium", "task.env_id=tests.tasks.gymnasium.odd:Mixed-v0", *TINY,
    "task.success.kind=terminated", "task.network.channels=[4]",
    "+task.parameters.goal={values: [1.0, 3.0], target: 3.0}",
]  # fmt: skip


GATE = [word.replace("task.evaluation.levels", "task.levels") for word in TINY]  # the point mass's


NO_BOX2D = pytest.mark.skipif(
    sys.version_info >= (3, 14) and find_spec("Box2D") is None,
    reason="Box2D would have to be compiled for this Python",
)


LOCK = Lock()


class Engine:
    speed = 1.0
    memory = False


class Walk(gymnasium.Env[Any, Any]):
    """On a line, to the right of `width`; a step is of the engine's speed, and noisy."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Discrete(2, start=1)

    def __init__(self, width: float = 2.0, render_mode: str | None = None) -> None:
        if width <= 0:
            raise ValueError("width must be positive")
        self.width = width
        self.engine = Engine()
        self.wind = 0.0
        self.kept: list[Any] = []

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.kept.append((seed, options))
        self.place = float(self.np_random.normal()) * 0.1 + (options or {}).get("start", 0.0)
        return np.array([self.place, self.width]), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self.place += self.engine.speed * (1 if action == 2 else -1) + self.wind
        self.place += 0.1 * float(self.np_random.normal())
        seen = np.array([self.place, self.width])
        return seen, self.place, self.place > self.width, False, {"far": self.place < -1}


def set_wind(environment: Walk, strength: float) -> None:
    environment.wind = strength / 10


gymnasium.register("Walk-v0", Walk, max_episode_steps=LIMIT)

PARAMETERS = {
    "speed": ParameterSettings(name="engine.speed", low=0.5, high=1.5, bins=2, target=[1.0, 1.25]),
    "width": ParameterSettings(set="argument", values=[1.0, 2.0], target=2.0),
    "begin": ParameterSettings(set="option", name="start", values=[0, 1], target=[0, 1]),
    "wind": ParameterSettings(
        set="call", name="tests.tasks.gymnasium.toys.set_wind", values=[-1, 1], target=1
    ),
}


def walk_task(**changed: Any) -> GymnasiumTask:
    ppo = PPOSettings(horizon=8, epochs=2, learning_rate=3e-3)
    parts: dict[str, Any] = {
        "env_id": WALK,
        "arguments": {},
        "wrappers": [],
        "max_steps": None,
        "parameters": PARAMETERS,
        "success": SuccessSettings(kind="terminated"),
        "network": NetworkSettings(hidden=[8]),
        "evaluation": EvaluationSettings(levels=8),
        "vectorization": "sync",
        "extra": None,
        "solver": SolverSettings(batch_size=4, ppo=ppo),
        "context": ComputeContext(),
    }
    return GymnasiumTask(**{**parts, **changed})
