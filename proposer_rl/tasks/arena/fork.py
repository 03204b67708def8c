"""A corridor with a reward at its right end, or at its left one where it is deep."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step, Values

DEEP = 0.97  # from which depth on the reward is at the left


class ForkEnv(BatchedEnv):
    """A corridor of cells that is entered in the middle.

    The reward of 1 is ``length`` cells to the right, and a trap two cells to the left, which ends
    an episode with nothing. In levels whose ``depth`` is above :data:`DEEP` it is the other way
    round, which is told by the depth that is seen alone.
    """

    state_size = 1
    observation_size = 3
    actions = 2

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the next cell: action 1 leads to the right, 0 to the left."""
        place = state.squeeze(-1) + 2 * action - 1
        right_way = torch.where(level["depth"] > DEEP, -place, place)
        end, trap = right_way >= level["length"], right_way <= -2
        return Step(place.unsqueeze(-1), end.float(), end | trap, end)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the place, the depth and the length, each about -1 to 1."""
        place = state.squeeze(-1) / 10
        return torch.stack([place, 2 * level["depth"] - 1, level["length"] / 5 - 1], -1)
