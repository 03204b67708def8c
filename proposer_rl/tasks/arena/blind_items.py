"""Two hundred problems in an order that says nothing about them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import functional

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step, uniform

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

    state_size: ClassVar[int] = 1
    observation_size: ClassVar[int] = SYMBOLS + 1
    actions: ClassVar[int | None] = ANSWERS

    def begin(self, level: Mapping[str, Tensor], chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 1]: the place 0 in the word."""
        return torch.zeros_like(level["item"], dtype=torch.float32).unsqueeze(-1)

    def advance(
        self, state: Tensor, action: Tensor, level: Mapping[str, Tensor], chance: Tensor
    ) -> Step:
        """Returns the step's result: the next symbol's place, and whether the answer was right."""
        right = action == _ANSWER.to(action.device)[self._symbol(state, level)]
        state = state + 1
        solved = right & (state.squeeze(-1) >= _LENGTH.to(action.device)[level["item"].long()])
        return Step(state, solved.float(), solved | ~right, solved)

    def observe(self, state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        """Returns the symbol to answer, and the share of the longest word that is still to come."""
        left = _LENGTH.to(state.device)[level["item"].long()].unsqueeze(-1) - state
        symbol = functional.one_hot(self._symbol(state, level), SYMBOLS)
        return torch.cat([symbol, left / LONGEST], -1)

    @staticmethod
    def _symbol(state: Tensor, level: Mapping[str, Tensor]) -> Tensor:
        place = state.squeeze(-1).long().clamp(max=LONGEST - 1)
        return _ASKED.to(state.device)[level["item"].long(), place]
