"""A walker that crosses a square through a crowd, and may be too slow for it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

LANES = (0.2, 0.4, 0.6, 0.8)  # where they walk from left to right or back
THICK = 0.05


class CrowdEnv(BatchedEnv):
    """A square that has to be crossed through four lanes with somebody in each of them.

    A step forward is as long as the level's ``pace``; the square is 1 deep. Its lanes are 2 long,
    and whoever leaves one at its end enters it at the other. The others, each ``size`` wide to
    both sides, walk with ``speed`` on average. To touch one ends the episode with 0, to be across
    with 1.
    """

    state_size: ClassVar[int] = 1 + len(LANES)  # how far across, and where the others are
    observation_size: ClassVar[int] = 4 + 2 * len(LANES)
    actions: ClassVar[int | None] = 2  # wait or go forward
    draws: ClassVar[int] = len(LANES)

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state: the agent below, the others anywhere in their lanes."""
        return torch.cat([torch.zeros_like(chance[..., :1]), 2 * chance - 1], -1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: all next places, the others' after steps of random length."""
        y = state[..., 0] + level["pace"] * action
        ways = 1 - 2 * (torch.arange(len(LANES), device=y.device) % 2)
        others = _around(state[..., 1:] + ways * 2 * chance * level["speed"].unsqueeze(-1))
        near = (y.new_tensor(LANES) - y.unsqueeze(-1)).abs() < THICK
        hit = (near & (others.abs() < level["size"].unsqueeze(-1))).any(-1)
        across = (y >= 1) & ~hit
        state = torch.cat([y.unsqueeze(-1), others], -1)
        return Step(state, across.float(), hit | across, across)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns how far it is, the level, where the others are, and how far it is to each."""
        y, others = state[..., :1], state[..., 1:]
        scaled = [20 * level["pace"] - 1, 10 * level["speed"] - 1, 4 * level["size"] - 1]
        lanes = state.new_tensor(LANES)
        return torch.cat([2 * y - 1, torch.stack(scaled, -1), others, 2 * (lanes - y)], -1)


def _around(x: Tensor) -> Tensor:
    """Returns places on the circle from -1 to 1."""
    return (x + 1) % 2 - 1
