"""A pendulum that is to be swung up and held there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

GRAVITY, FASTEST = 10.0, 8.0  # as in Gymnasium's Pendulum-v1
SECONDS = 0.06  # of a step
UPRIGHT, HELD = 0.9, 12  # cosine of the angle, and for how many steps in a row it is a success


class SwingEnv(BatchedEnv):
    """Gymnasium's Pendulum-v1 with other masses, lengths and engines, which hangs at first.

    The level's ``torque`` is the strongest; a pendulum of mass and length 1 is held level by 5.
    The reward of a step rises from 0 below to 0.02 above, less a little for speed; a success is
    upright in all of the last :data:`HELD` steps.
    """

    state_size: ClassVar[int] = 3  # angle, speed, steps upright
    observation_size: ClassVar[int] = 6
    draws: ClassVar[int] = 1

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 3]: the pendulum hangs about straight down, at rest."""
        angle = torch.pi + chance - 0.5
        return torch.cat([angle, torch.zeros_like(angle), torch.zeros_like(angle)], -1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the pendulum's next angle and speed, and its steps upright."""
        angle, speed, held = state.unbind(-1)
        mass, length = level["mass"], level["length"]
        torque = action.squeeze(-1) * level["torque"]
        pull = 1.5 * GRAVITY / length * angle.sin() + 3 * torque / (mass * length**2)
        speed = (speed + SECONDS * pull).clamp(-FASTEST, FASTEST)
        angle = angle + SECONDS * speed
        height = angle.cos()
        held = (held + 1) * (height > UPRIGHT)
        reward = 0.01 * (1 + height) - 0.0001 * speed.square()
        never = torch.zeros_like(held, dtype=torch.bool)
        return Step(torch.stack([angle, speed, held], -1), reward, never, held >= HELD)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns the angle's cosine and sine, the speed and the level, each about -1 to 1."""
        angle, speed, _ = state.unbind(-1)
        own = [level["mass"] - 1, level["length"] - 1, level["torque"] / 4 - 1]
        return torch.stack([angle.cos(), angle.sin(), speed / FASTEST, *own], -1)
