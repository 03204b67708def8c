"""A cart that balances a pole, with physics that differ in ten numbers, three of them idle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

# What is seen of a level, with the middle and half the width of its usual range.
PHYSICS = {
    "gravity": (15.0, 10.0),
    "cart": (1.5, 1.25),
    "pole": (0.5, 0.45),
    "length": (0.6, 0.5),
    "force": (10.5, 9.5),
    "tau": (0.03, 0.02),
    "friction": (0.5, 0.5),
}
EDGE, FALLEN = 2.4, 12 * torch.pi / 180


class CartEnv(BatchedEnv):
    """Cart and pole after Barto et al. 1983, with the contexts of CARL (Benjamins et al. 2023).

    A level's ``gravity``, masses of ``cart`` and ``pole``, half ``length`` of the pole, ``force``
    of a push, seconds ``tau`` of a step and ``friction`` of the cart are its physics; whatever else
    it has does nothing. Every step returns 1. Success is to survive them all.
    """

    state_size: ClassVar[int] = 4
    observation_size: ClassVar[int] = 4 + len(PHYSICS)
    actions: ClassVar[int | None] = 2
    draws: ClassVar[int] = 4

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial place, speed, angle and angular speed [*B, 4], each within ±0.05."""
        return 0.1 * chance - 0.05

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the four numbers after a step of Euler's method."""
        place, speed, angle, turning = state.unbind(-1)
        total, moment = level["cart"] + level["pole"], level["pole"] * level["length"]
        sine, cosine = angle.sin(), angle.cos()
        push = (2 * action - 1) * level["force"] - level["friction"] * speed
        pull = (push + moment * turning.square() * sine) / total
        turn = (level["gravity"] * sine - cosine * pull) / (
            level["length"] * (4 / 3 - level["pole"] * cosine.square() / total)
        )
        gain = pull - moment * turn * cosine / total
        change = torch.stack([speed, gain, turning, turn], -1)
        state = state + level["tau"].unsqueeze(-1) * change
        lost = (state[..., 0].abs() > EDGE) | (state[..., 2].abs() > FALLEN)
        return Step(state, torch.ones_like(place), lost, ~lost)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns the state and the physics, each about -1 to 1."""
        physics = [(level[name] - middle) / half for name, (middle, half) in PHYSICS.items()]
        scale = state.new_tensor([EDGE, 2.0, FALLEN, 2.0])
        return torch.cat([state / scale, torch.stack(physics, -1)], -1)
