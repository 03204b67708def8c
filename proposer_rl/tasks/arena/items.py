"""Two hundred problems each, in an order that says nothing about them: words, and goals."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from proposer_rl.tasks.arena.planes import FAR, ReachEnv, goal
from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values, uniform

ITEMS, SYMBOLS, ANSWERS, LONGEST = 200, 24, 4, 17

# An item's rank from the easiest, 0, to the hardest; its symbols are drawn from the first few, and
# the harder an item, the more of them and the more numerous they are.
_RANK = uniform(torch.tensor([1]), torch.tensor([0]), ITEMS).argsort()
_LENGTH = 1 + _RANK * LONGEST // ITEMS
_KNOWN = 2 + _RANK * (SYMBOLS - 1) // ITEMS
_ASKED = uniform(torch.arange(ITEMS).unsqueeze(-1), torch.tensor([3]), LONGEST)
_ASKED = (_ASKED * _KNOWN.unsqueeze(-1)).long()
_ANSWER = (uniform(torch.tensor([2]), torch.tensor([0]), SYMBOLS) * ANSWERS).long()


class BlindItemsEnv(BatchedEnv):
    """Words whose symbols have to be answered one by one, each by the one right answer it has.

    The level's ``item``, 0 to 199, is the word's number. A wrong answer ends the episode, and the
    last right one does so with 1.
    """

    state_size = 1
    observation_size = SYMBOLS + 1
    actions = ANSWERS

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the next symbol's place, and whether the answer was right."""
        right = action == _ANSWER.to(action.device)[self._symbol(state, level)]
        state = state + 1
        solved = right & (state.squeeze(-1) >= _LENGTH.to(action.device)[level["item"].long()])
        return Step(state, solved.float(), solved | ~right, solved)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the symbol to answer, and the share of the longest word that is still to come."""
        left = _LENGTH.to(state.device)[level["item"].long()].unsqueeze(-1) - state
        symbol = functional.one_hot(self._symbol(state, level), SYMBOLS)
        return torch.cat([symbol, left / LONGEST], -1)

    @staticmethod
    def _symbol(state: Tensor, level: Values) -> Tensor:
        place = state.squeeze(-1).long().clamp(max=LONGEST - 1)
        return _ASKED.to(state.device)[level["item"].long(), place]


NUMBERS = uniform(torch.full((ITEMS, 1), 7), torch.arange(ITEMS).unsqueeze(-1), 4)  # of each item
NEAREST = 0.4


class PairsEnv(ReachEnv):
    """A point that is pushed to the goal of the level's ``item``, whose number tells nothing."""

    @classmethod
    def features(cls, level: Values) -> Tensor:
        """Returns distance, goal and two numbers without a meaning, float [*B, 5], -1 to 1."""
        place = problem(level)
        far = 2 * place["distance"].unsqueeze(-1) / FAR - 1
        idle = 2 * NUMBERS.to(far.device)[level["item"]][..., 2:] - 1
        return torch.cat([far, goal(place) / FAR, idle], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the point's next place and velocity."""
        return super().advance(state, action, problem(level), chance)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns what is seen of the item's goal."""
        return super().observe(state, problem(level))


def problem(level: Values) -> dict[str, Tensor]:
    """Returns the distance and direction of items int64 [*B], each float [*B]."""
    near, turn = NUMBERS.to(level["item"].device)[level["item"]][..., :2].unbind(-1)
    return {"distance": NEAREST + (FAR - NEAREST) * near, "direction": 2 * turn - 1}
