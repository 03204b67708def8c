"""Curricula over data sets: a sampler of items whose results come back later."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from torch.utils.data import Sampler

from proposer_rl.settings import ArgumentError, Count, checked
from proposer_rl.teaching.spaces import Items
from proposer_rl.teaching.teacher import Teacher
from proposer_rl.teaching.tickets import as_array

T = TypeVar("T")


class TeacherSampler(Sampler[int]):
    """Items that a teacher proposes, for any loader; whoever scores them tells by item.

    Importing TorchRL makes processes spawn: a script whose loader has workers needs its
    ``if __name__ == "__main__":``.

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
        self._out: dict[int, list[int]] = defaultdict(list)  # tickets of each item

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
            ArgumentError: for an item that is not out, or another number of results; none of them
                counts then.
        """
        told = self._told(items)
        means = self._means("success", success, len(told))
        returns = means if return_ is None else self._means("return_", return_, len(told))
        self._teacher.tell([t for _, t in told], returns, means, episodes=self._repeat)
        self._forget(told)

    def drop(self, items: Sequence[int] | None = None) -> None:
        """Nothing will come of items.

        Args:
            items: as of :meth:`tell`; None for all that are out, as where a resumed loop begins
                an epoch anew.
        """
        every = [(item, ticket) for item, tickets in self._out.items() for ticket in tickets]
        dropped = every if items is None else self._told(items)
        self._teacher.drop([ticket for _, ticket in dropped])
        self._forget(dropped)

    def state_dict(self) -> dict[str, Any]:
        """The tickets of the items that are out; the teacher has a state of its own."""
        return {"out": {item: list(tickets) for item, tickets in self._out.items() if tickets}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        self._out.clear()
        self._out.update({item: list(tickets) for item, tickets in state["out"].items()})

    def _told(self, items: Sequence[int]) -> list[tuple[int, int]]:
        """The item and the ticket of each group of items [n]."""
        numbers = _plain("items", items, int)
        if len(numbers) % self._repeat:
            raise ArgumentError(f"items: {len(numbers)} are no groups of {self._repeat}")
        left = {item: list(self._out[item]) for item in {*numbers} & self._out.keys()}
        told = []
        for start in range(0, len(numbers), self._repeat):
            item = numbers[start]
            if not left.get(item) or len({*numbers[start : start + self._repeat]}) > 1:
                raise ArgumentError(f"items={item}: is not out")
            told.append((item, left[item].pop(0)))
        return told

    def _forget(self, told: list[tuple[int, int]]) -> None:
        for item, ticket in told:
            self._out[item].remove(ticket)

    def _means(self, name: str, values: Any, groups: int) -> list[float]:
        """Of each group the mean of its numbers."""
        numbers, size = _plain(name, values, float), self._repeat
        if len(numbers) != groups * size:
            raise ArgumentError(f"{name}: {len(numbers)} results for {groups * size} items")
        as_array(name, numbers, (len(numbers),))  # each of them, not their mean alone
        return [sum(numbers[at : at + size]) / size for at in range(0, len(numbers), size)]


def _plain(name: str, values: Any, kind: Callable[[Any], T]) -> list[T]:
    """Numbers [n] as Python's, brought from a device all at once."""
    try:
        return [*map(kind, values.tolist() if hasattr(values, "tolist") else values)]
    except TypeError as error:
        raise ArgumentError(f"{name}: must be numbers [n]") from error
