"""A point that is drawn into a dead end, because the goal lies right behind it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

STRIDE, NEAR = 0.2, 0.3


class LureEnv(BatchedEnv):
    """A trap with three walls, open towards the start, between the start and the goal.

    The goal is ``distance`` to the right of the start. Half-way stands a wall as high as the
    trap's ``width``; from both of its ends walls of a length of ``depth`` go back towards the
    start. A step returns how much nearer it gets; the goal ends the episode, with 1 more.
    """

    state_size: ClassVar[int] = 2
    observation_size: ClassVar[int] = 5
    forces: ClassVar[int] = 2
    draws: ClassVar[int] = 1

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: a place near the origin."""
        return torch.cat([torch.zeros_like(chance), 0.2 * chance - 0.1], -1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the next place, moved along x, then along y, up to walls."""
        x, y = state.unbind(-1)
        new_x, new_y = (state + STRIDE * action).unbind(-1)
        wall, half = level["distance"] / 2, level["width"] / 2
        held = ((x < wall) != (new_x < wall)) & (y.abs() < half)
        new_x = torch.where(held, x, new_x)
        beside = (new_x < wall) & (new_x > wall - level["depth"])
        held = beside & ((new_y.abs() < half) != (y.abs() < half))
        new_y = torch.where(held, y, new_y)
        before, after = (torch.hypot(level["distance"] - a, b) for a, b in ((x, y), (new_x, new_y)))
        there = after < NEAR
        return Step(torch.stack([new_x, new_y], -1), before - after + there, there, there)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns the place, and the trap's depth, distance and width, each about -1 to 1."""
        seen = [level["depth"] - 1, level["distance"] / 2 - 2, level["width"] - 1]
        return torch.cat([state / 2, torch.stack(seen, -1)], -1)
