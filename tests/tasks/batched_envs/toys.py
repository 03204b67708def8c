"""Balls in the wind: an environment whose steps anybody can compute, and a task made of it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from proposer_rl.learning import PPOSettings, SolverSettings
from proposer_rl.task import ComputeContext
from proposer_rl.tasks.batched_envs import BatchedEnv, BatchedTask, Step, Values
from proposer_rl.tasks.gymnasium.networks import NetworkSettings
from proposer_rl.tasks.ranges import RangeSettings

STILL = "tests.tasks.batched_envs.toys.StillEnv"
TOY = "tests.tasks.batched_envs.toys.WindyEnv"


class WindyEnv(BatchedEnv):
    """A ball begins between 0 and 1, and is pushed by the action and by the wind; 3 is the end."""

    state_size = 1
    observation_size = 2
    draws = 2

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        return chance[..., :1]

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        blown = level["wind"].unsqueeze(-1) * chance[..., 1:]
        place = (state + action + blown).squeeze(-1)
        return Step(place.unsqueeze(-1), -place.abs(), place > 3, place > 2)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        return torch.stack([state.squeeze(-1), level["wind"]], -1)


class StillEnv(BatchedEnv):
    """Counts its choices, of three, from a whole number on; nothing is random."""

    state_size = 1
    observation_size = 1
    actions = 3

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        assert chance.shape == (*self.batch_size, 0)
        return level["first"].unsqueeze(-1).float()

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        after = state + action.unsqueeze(-1)
        good = after.squeeze(-1) > 6
        return Step(after, good.float(), torch.zeros_like(good), good)


def windy_task(**changed: Any) -> BatchedTask:
    parts: dict[str, Any] = dict(
        env=TOY,
        max_steps=8,
        parameters={"wind": RangeSettings(low=0.0, high=2.0, bins=4, target=0.5)},
        network=NetworkSettings(hidden=[8]),
        levels=8,
        solver=SolverSettings(batch_size=4, ppo=PPOSettings(horizon=8, epochs=2)),
        context=ComputeContext(),
    )
    return BatchedTask(**{**parts, **changed})
