"""A car in a valley, whose engine may be too weak to climb out at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step


class HillEnv(BatchedEnv):
    """Gymnasium's MountainCar-v0 with engines of many strengths, and without a reward on the way.

    The level's ``force`` is the acceleration of the engine; 0.001 is Gymnasium's. An episode ends
    with 1 on the top, and returns 0 else.
    """

    state_size: ClassVar[int] = 2
    observation_size: ClassVar[int] = 3
    actions: ClassVar[int | None] = 3
    draws: ClassVar[int] = 1

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial place near the bottom and speed 0, [*B, 2]."""
        place = -0.6 + 0.2 * chance
        return torch.cat([place, torch.zeros_like(place)], -1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the car's next place and speed."""
        place, speed = state.unbind(-1)
        push = (action - 1) * level["force"] - 0.0025 * (3 * place).cos()
        speed = (speed + push).clamp(-0.07, 0.07)
        place = (place + speed).clamp(-1.2, 0.6)
        speed = torch.where((place <= -1.2) & (speed < 0), 0.0, speed)
        top = place >= 0.5
        return Step(torch.stack([place, speed], -1), top.float(), top, top)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns place, speed and the engine's force, each about -1 to 1."""
        place, speed = state.unbind(-1)
        return torch.stack([place + 0.3, speed / 0.07, level["force"] / 0.003 - 1], -1)
