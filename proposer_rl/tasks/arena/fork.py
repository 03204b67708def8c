"""A corridor with a reward at its right end, or at its left one where it is deep."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

DEEP = 0.97  # from which depth on the reward is at the left


class ForkEnv(BatchedEnv):
    """A corridor of cells that is entered in the middle.

    The reward of 1 is ``length`` cells to the right, and a trap two cells to the left, which ends
    an episode with nothing. In levels whose ``depth`` is above :data:`DEEP` it is the other way
    round, which is told by the depth that is seen alone.
    """

    state_size: ClassVar[int] = 1
    observation_size: ClassVar[int] = 3
    actions: ClassVar[int | None] = 2

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 1]: the cell in the middle."""
        return chance.new_zeros(*self.batch_size, 1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the next cell, to the right by action 1, to the left by 0."""
        place = state.squeeze(-1) + 2 * action - 1
        right_way = torch.where(level["depth"] > DEEP, -place, place)
        end, trap = right_way >= level["length"], right_way <= -2
        return Step(place.unsqueeze(-1), end.float(), end | trap, end)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns the place, the depth and the length, each about -1 to 1."""
        place = state.squeeze(-1) / 10
        return torch.stack([place, 2 * level["depth"] - 1, level["length"] / 5 - 1], -1)
