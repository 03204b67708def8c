"""A point in the plane that is pushed to a goal, far or near, in any direction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step

FAR = 4.0  # about the largest distance
RADIUS = 0.3  # of the goal
DRAG, THRUST = 0.8, 0.03  # the largest speed of an axis is THRUST / (1 - DRAG)
COST = 0.002  # of a step with a force of length 1


class ReachEnv(BatchedEnv):
    """A point with drag that begins at the origin, and is rewarded at the goal alone.

    The goal lies at the level's ``distance`` in its ``direction``, in half turns. Forces cost a
    little, so that failures differ.
    """

    state_size: ClassVar[int] = 4
    observation_size: ClassVar[int] = 6
    forces: ClassVar[int] = 2

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 4]: the point at the origin, at rest."""
        return chance.new_zeros(*self.batch_size, 4)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the point's next state, and whether it is at the goal."""
        velocity = DRAG * state[..., 2:] + THRUST * action
        place = state[..., :2] + velocity
        there = (goal(level) - place).square().sum(-1) <= RADIUS**2
        reward = there.float() - COST * action.square().sum(-1)
        return Step(torch.cat([place, velocity], -1), reward, there, there)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns where the goal is and lies from here, and the velocity, each about -1 to 1."""
        there, top = goal(level), THRUST / (1 - DRAG)
        apart = there - state[..., :2]
        return torch.cat([there / FAR, apart / FAR, state[..., 2:] / top], -1)


def goal(level: Mapping[str, Tensor]) -> Tensor:
    """Returns where the goals of levels [*B] lie, float [*B, 2]."""
    turn = torch.pi * level["direction"]
    return level["distance"].unsqueeze(-1) * torch.stack([turn.cos(), turn.sin()], -1)
