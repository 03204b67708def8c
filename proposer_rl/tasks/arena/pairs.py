"""Two hundred goals in the plane that were drawn once, and differ in features."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from proposer_rl.tasks.arena.reach import FAR, ReachEnv, goal
from proposer_rl.tasks.batched_envs.env import Step, uniform

ITEMS = 200
NUMBERS = uniform(torch.full((ITEMS, 1), 7), torch.arange(ITEMS).unsqueeze(-1), 4)  # of each item
NEAREST = 0.4


class PairsEnv(ReachEnv):
    """A point that is pushed to the goal of the level's ``item``, whose number tells nothing."""

    @classmethod
    def features(cls, level: Mapping[str, Tensor]) -> Tensor:
        """Returns distance, goal and two numbers without a meaning, float [*B, 5], -1 to 1."""
        place = problem(level)
        far = 2 * place["distance"].unsqueeze(-1) / FAR - 1
        idle = 2 * NUMBERS.to(far.device)[level["item"]][..., 2:] - 1
        return torch.cat([far, goal(place) / FAR, idle], -1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the point's next place and velocity."""
        return super().advance(state, action, problem(level), chance)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns what is seen of the item's goal."""
        return super().observe(state, problem(level))


def problem(level: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the distance and direction of items int64 [*B], each float [*B]."""
    near, turn = NUMBERS.to(level["item"].device)[level["item"]][..., :2].unbind(-1)
    return {"distance": NEAREST + (FAR - NEAREST) * near, "direction": 2 * turn - 1}
