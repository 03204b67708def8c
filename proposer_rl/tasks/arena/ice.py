"""A strip of ice between two rows of pits, on which one slips to the sides."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

AHEAD, LEFT, RIGHT, WAIT = range(4)
SINK = -0.1  # what a pit costs


class IceEnv(BatchedEnv):
    """A walk along a strip of ``width`` cells, ``length`` of them, with pits on both sides.

    Instead of an action one slips to the left or to the right with the probability ``slip``. The
    end pays 1 and a pit slightly less than nothing, which is what is left when time is over.
    """

    state_size: ClassVar[int] = 2
    observation_size: ClassVar[int] = 5
    actions: ClassVar[int | None] = 4
    draws: ClassVar[int] = 2

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: the first cell of the middle row."""
        return torch.stack([torch.zeros_like(level["slip"]), level["width"] // 2], -1).float()

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the next cell, and whether it is a pit or the end."""
        along, across = state.unbind(-1)
        aside = torch.where(chance[..., 1] < 0.5, LEFT, RIGHT)
        move = torch.where(chance[..., 0] < level["slip"], aside, action)
        along = along + (move == AHEAD)
        across = across + (move == RIGHT).float() - (move == LEFT).float()
        pit = (across < 0) | (across >= level["width"])
        end = along >= level["length"]
        return Step(torch.stack([along, across], -1), end + SINK * pit, pit | end, end)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns the cells to the end and to each side, the width and slip, about 0 to 1."""
        along, across = state.unbind(-1)
        left, right = across / 4, (level["width"] - 1 - across) / 4
        ahead = (level["length"] - along) / 14
        return torch.stack([ahead, left, right, level["width"] / 5, level["slip"] / 0.4], -1)
