"""A corridor with four doors at its end, and a word at its beginning on which of them to take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

DOORS, LONGEST = 4, 12


class RecallEnv(BatchedEnv):
    """A corridor of ``length`` cells, which has to be walked with a number from 0 to 3 in mind.

    The number is shown in the first cell, and in each later one another that means nothing, with
    the probability ``noise``. Action 0 goes on, the others go through a door, which there is in the
    last cell alone; the right one returns 1.
    """

    state_size: ClassVar[int] = 3  # cell, door, number that is shown or -1
    observation_size: ClassVar[int] = DOORS + 4
    actions: ClassVar[int | None] = 1 + DOORS
    draws: ClassVar[int] = 2

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 3]: the first cell, where the door is shown."""
        door = (DOORS * chance[..., 0]).floor()
        return torch.stack([torch.zeros_like(door), door, door], -1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the next cell, or the end of the episode behind a door."""
        cell, door, shown = state.unbind(-1)
        last = level["length"] - 1
        left = (cell >= last) & (action > 0)
        right = left & (action - 1 == door)
        walked = (action == 0) & (cell < last)
        cell = cell + walked
        other = torch.where(chance[..., 0] < level["noise"], (DOORS * chance[..., 1]).floor(), -1.0)
        shown = torch.where(cell > 0, other, shown)
        return Step(torch.stack([cell, door, shown], -1), right.float(), left, right)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns what is shown, whether here is the first or the last cell, and the level."""
        cell, _, shown = state.unbind(-1)
        number = functional.one_hot(shown.long() + 1, 1 + DOORS)[..., 1:]
        last = level["length"] - 1
        ends = [cell == 0, cell >= last, last / (LONGEST - 1), level["noise"]]
        return torch.cat([number, torch.stack([end.float() for end in ends], -1)], -1)
