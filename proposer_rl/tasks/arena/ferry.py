"""A ferry that a river carries away from its dock."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

STEPS, STEER, GUST = 20, 0.1, 0.05


class FerryEnv(BatchedEnv):
    """A crossing of 20 steps, in which the ferry has to be steered against the river and gusts.

    A step carries it aside by a tenth of the level's ``current``, and of the rudder, -1 to 1, and
    by a gust at random. Success, which returns 1, is to be nearer to the dock than half its
    ``width`` when the other bank is reached.
    """

    state_size: ClassVar[int] = 2  # how far aside, and across
    observation_size: ClassVar[int] = 4
    draws: ClassVar[int] = 1

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: a place on the bank, about opposite the dock."""
        return torch.cat([0.4 * chance - 0.2, torch.zeros_like(chance)], -1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the ferry's next place, and whether it has landed."""
        drift = STEER * (level["current"] + action[..., 0]) + GUST * (2 * chance[..., 0] - 1)
        aside, across = state[..., 0] + drift, state[..., 1] + 1
        over = across >= STEPS
        landed = over & (aside.abs() < level["width"] / 2)
        return Step(torch.stack([aside, across], -1), landed.float(), over, landed)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns how far aside and across, current and width, each about -1 to 1."""
        aside, across = state.unbind(-1)
        seen = [aside, across / 10 - 1, level["current"], level["width"] - 1]
        return torch.stack(seen, -1)
