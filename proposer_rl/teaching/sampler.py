"""Curricula over data sets: a sampler of items whose results come back later."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from typing import Any

from torch.utils.data import Sampler

from proposer_rl.settings import ArgumentError, Count, checked
from proposer_rl.teaching.spaces import Items
from proposer_rl.teaching.teacher import Teacher


class TeacherSampler(Sampler[int]):
    """Items that a teacher proposes, for any loader; whoever scores them tells by item.

    Args:
        teacher: of :class:`Items`.
        length: items of an epoch.
        repeat: how many times each comes, one after another, as groups of answers to one prompt.
        group: items that are repeated together before they come again; with ``rounds``.
        rounds: how many times each group comes over again.

    Raises:
        ArgumentError: if the teacher's levels are no items.
    """

    @checked
    def __init__(
        self,
        teacher: Teacher,
        length: Count,
        *,
        repeat: Count = 1,
        group: Count = 1,
        rounds: Count = 1,
    ) -> None:
        if not isinstance(teacher.space, Items):
            raise ArgumentError("teacher: must have a space of Items")
        self._teacher, self._length = teacher, length
        self._repeat, self._group, self._rounds = repeat, group, rounds
        self._out: dict[int, deque[int]] = defaultdict(deque)  # tickets of each item

    def __len__(self) -> int:
        return self._length * self._repeat * self._rounds

    def __iter__(self) -> Iterator[int]:
        for start in range(0, self._length, self._group):
            group = [self._teacher.ask() for _ in range(min(self._group, self._length - start))]
            for ticket, item in group:
                self._out[item].append(ticket)
            for _ in range(self._rounds):
                for _, item in group:
                    yield from [item] * self._repeat

    def tell(self, items: Sequence[int], success: Any, return_: Any = None) -> None:
        """What came of items, in groups: equal ones next to each other are one result.

        Args:
            items: as they were drawn, with their repetitions, [n].
            success: of each, from 0 to 1, [n].
            return_: of each; None for the success.

        Raises:
            ArgumentError: for an item that is not out, or another number of results.
        """
        items, returns = [int(item) for item in items], success if return_ is None else return_
        if not len(items) == len(success) == len(returns):
            raise ArgumentError(f"success: {len(success)} results for {len(items)} items")
        if len(items) % self._repeat:
            raise ArgumentError(f"items: {len(items)} are no groups of {self._repeat}")
        for start in range(0, len(items), self._repeat):
            here = slice(start, start + self._repeat)
            if not self._out[items[start]] or len({*items[here]}) > 1:
                raise ArgumentError(f"items={items[start]}: is not out")
            means = [sum(map(float, each[here])) / self._repeat for each in (returns, success)]
            self._teacher.tell(self._out[items[start]][0], *means, episodes=self._repeat)
            self._out[items[start]].popleft()
