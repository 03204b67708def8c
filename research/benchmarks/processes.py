"""One Solver's environments of Gymnasium one after another, and in several processes."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch

from proposer_rl.tasks.gymnasium.batched_env import GymnasiumEnv, Vectorization
from proposer_rl.tasks.gymnasium.environment import SuccessSettings
from proposer_rl.tasks.gymnasium.player import MakeEnvironment
from proposer_rl.tasks.parameters import ParameterSpace
from research.benchmarks.environment import through_torchrl
from research.benchmarks.results import Options, Result, Row
from research.benchmarks.timing import interleave, ratio

BATCH = 8
STEPS = {0.0: 200, 0.5: 100, 5.0: 20}  # of a timing, by milliseconds that one takes


class Costly(gymnasium.Env[Any, Any]):
    """Computes for so many milliseconds at each step, and does nothing else."""

    observation_space = gymnasium.spaces.Box(-1, 1, (24,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (4,), np.float32)

    def __init__(self, milliseconds: float) -> None:
        self._seconds = milliseconds / 1000

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Show zeros."""
        super().reset(seed=seed)
        return np.zeros(24, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Compute."""
        end = time.process_time() + self._seconds
        while time.process_time() < end:
            pass
        return np.zeros(24, np.float32), 0.0, False, False, {}


gymnasium.register("Costly-v0", f"{__name__}:Costly", max_episode_steps=10**6)


def in_processes(options: Options) -> Result:
    """Random actions in the same environments, whose steps cost more and more."""
    rows = []
    levels = ParameterSpace({}).sample(BATCH, torch.Generator().manual_seed(0))
    for cost, steps in STEPS.items():
        actions = torch.zeros(2 if options.tiny else steps, BATCH, 4)
        make = MakeEnvironment(f"{__name__}:Costly-v0", {"milliseconds": cost})
        rule = SuccessSettings(kind="survived")
        how: tuple[Vectorization, ...] = ("sync", "async")
        envs = {
            name: GymnasiumEnv(levels, make, {}, success=rule, vectorization=name) for name in how
        }
        seconds = interleave(
            {name: partial(through_torchrl, env, actions) for name, env in envs.items()},
            options.repeats,
        )
        for env in envs.values():
            env.close()
        rows.append(
            Row(
                f"speed of {BATCH} environments of {cost:g} ms a step",
                f"vectorization=async in {BATCH} processes, against sync",
                ratio(seconds["sync"], seconds["async"]),
                "x",
                samples=seconds,
            )
        )
    return Result(rows)
