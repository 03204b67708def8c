"""A point that walks around a square block of walls to a goal, within a tolerance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

STRIDE = 0.3
BORDER, BLOCK = 7.0, 5.0  # the floor ends at the first, and begins at the second
REACH = 9.0  # goals lie within it, many of them in walls


class GoalMazeEnv(BatchedEnv):
    """The sparse goal reaching of Klink et al. 2022, ICML (CurrOT).

    The floor is a corridor around a block. An episode begins in the lower left corner, and returns
    1 as soon as the point is nearer to the goal (``x``, ``y``) than ``tolerance``, and 0 else.
    """

    state_size: ClassVar[int] = 2
    observation_size: ClassVar[int] = 5
    forces: ClassVar[int] = 2
    draws: ClassVar[int] = 2

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: a place in the corner."""
        return (BORDER - BLOCK) * chance - BORDER

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the next place; a wall stops the axis on which it is met."""
        length = action.norm(dim=-1, keepdim=True).clamp(min=1)
        place = (state + STRIDE * action / length).clamp(-BORDER, BORDER)
        inside = (place.abs() < BLOCK).all(-1, keepdim=True)
        stopped = torch.where(state.abs() >= BLOCK, BLOCK * state.sign(), place)
        place = torch.where(inside, stopped, place)
        goal = torch.stack([level["x"], level["y"]], -1)
        there = (goal - place).norm(dim=-1) < level["tolerance"]
        return Step(place, there.float(), there, there)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns the place, the goal and the tolerance, each from -1 to 1."""
        seen = torch.stack([level["x"], level["y"], level["tolerance"] - REACH], -1)
        return torch.cat([state, seen], -1) / REACH
