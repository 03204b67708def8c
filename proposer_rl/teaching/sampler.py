"""Curricula over data sets: a sampler of items, to which results are told later."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import inf
from typing import Any, NamedTuple, TypeVar
from zlib import crc32

from torch import distributed
from torch.utils.data import Sampler

from proposer_rl.settings import ArgumentError, Count, checked
from proposer_rl.teaching.identity import require_same
from proposer_rl.teaching.numbers import as_ids, as_numbers
from proposer_rl.teaching.results import MOST
from proposer_rl.teaching.teacher import Teacher

T = TypeVar("T")

FEW = 32  # items, before which it is too early to say that most results are missing


class Answer(NamedTuple):
    """Success and return of an answer to an item, or the means of several answers."""

    success: float
    return_: float
    episodes: float = 1


def _mean(answers: list[Answer]) -> Answer:
    episodes = sum(one.episodes for one in answers)
    success = sum(one.success * one.episodes for one in answers) / episodes
    return Answer(success, sum(one.return_ * one.episodes for one in answers) / episodes, episodes)


@dataclass
class Epoch:
    """The items drawn in an epoch, and the number given to the loop, with repetitions."""

    drawn: list[int] = field(default_factory=list)
    place: int = 0


class TeacherSampler(Sampler[int]):
    """Samples the items that a teacher proposes, for any loader, and takes results by item.

    An item is out until ``repeat`` answers to it were told, in any order and over any number of
    calls; the teacher gets their means.

    In a launch of several ranks, make the same teacher and the same sampler on every rank, draw
    from it in step, and tell the results of the rank's own part. :meth:`tell` and :meth:`drop`
    gather those of all ranks where ``torch.distributed`` is initialized, so that all teachers stay
    the same.

    Importing TorchRL makes processes spawn: a script whose loader has workers needs
    ``if __name__ == "__main__":``.

    Args:
        teacher: a teacher of :class:`Items`.
        length: number of items of an epoch.
        repeat: number of times that each item comes in a row, as in groups of answers to a prompt.
        group: number of items after which a round ends, if there are several ``rounds``.
        rounds: number of times that each group comes.
        sources: the source of each item, [N], by which :meth:`metrics` are also given.
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
        sources: Any = None,
    ) -> None:
        self._teacher, self._length = teacher, length
        self._repeat, self._group, self._rounds = repeat, group, rounds
        self._out: dict[int, list[int]] = defaultdict(list)  # tickets of each item
        # Answers to items for which more are to come.
        self._came: dict[int, list[Answer | None]] = {}
        self._epoch, self._goes_on = Epoch(), False  # whether the next epoch is the rest of it
        self._asked, self._trace = 0, 0  # number of items since the start, and their checksum
        self._check: float = 0  # number of items at which to look for missing results again
        self._sources = sources
        self._sums: dict[str, tuple[float, int]] = {}  # with their counts, since metrics()

    def __len__(self) -> int:
        return self._length * self._repeat * self._rounds

    def __iter__(self) -> Iterator[int]:
        epoch = self._epoch = self._epoch if self._goes_on else Epoch()
        self._goes_on = False
        whole = self._group * self._repeat * self._rounds
        while epoch.place < len(self):
            number, place = divmod(epoch.place, whole)
            start = number * self._group
            size = min(self._group, self._length - start)
            while len(epoch.drawn) < start + size:
                epoch.drawn.append(self._ask())
            epoch.place += 1
            yield epoch.drawn[start + place // self._repeat % size]
        if self._epoch is epoch:
            self._epoch = Epoch()

    def rewind(self) -> None:
        """Restarts this epoch: its items come again from the first, before any new ones.

        For loops that skip batches after a resume, as by accelerate's ``skip_first_batches``.
        """
        self._epoch.place, self._goes_on = 0, True

    def tell(
        self, items: Sequence[int], success: Any, return_: Any = None, *, episodes: Any = None
    ) -> None:
        """Takes results of items; an item counts once its last answer was told.

        Args:
            items: items as they were drawn, with their repetitions, in any order, [n].
            success: success of each answer, from 0 to 1; None for an answer without a result, [n].
            return_: return of each answer; None for the success.
            episodes: number of answers that each number is the mean of; None for 1.

        Raises:
            ArgumentError: for an item that has fewer answers out, or another number of results; the
                call then has no effect on any rank.
        """
        self._count(lambda: _answers(items, success, return_, episodes))

    def drop(self, items: Sequence[int] | None = None) -> None:
        """Gives up items that will have no results.

        Args:
            items: as of :meth:`tell`; None for all that are out, as where a resumed loop begins a
                new epoch.
        """
        if items is None:
            self._teacher.drop([*chain.from_iterable(self._out.values())])
            self._out.clear()
            self._came.clear()
            self._epoch, self._goes_on = Epoch(), False
        else:
            self._count(lambda: [(item, None) for item in as_ids("items", items).tolist()])

    def metrics(self) -> dict[str, float]:
        """Returns means over the groups that were completed since the last call.

        ``success``; the success that the curriculum had ``predicted``, if it has a belief;
        ``yield``, the share of groups whose answers differ, as they also do if an answer is a mean
        between 0 and 1; ``no_variance``, the share of the others; and the same by source, as
        ``yield/SOURCE``. Empty if there was no group.
        """
        shown: dict[str, float] = {}
        for name, (total, number) in self._sums.items():
            shown[name] = total / number
            if name.startswith("yield"):
                shown[f"no_variance{name[5:]}"] = 1 - shown[name]
        self._sums = {}
        return shown

    def state_dict(self) -> dict[str, Any]:
        """Returns what is out and the place in the epoch, without the teacher's state."""
        return {
            "groups": [self._repeat, self._group, self._rounds],
            "out": {item: list(tickets) for item, tickets in self._out.items() if tickets},
            # torch.load(weights_only=True) loads tuples, but no named ones.
            "came": {i: [one and tuple(one) for one in each] for i, each in self._came.items()},
            "drawn": list(self._epoch.drawn),
            "place": self._epoch.place,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Loads a state; the next epoch is the rest of the one that had begun.

        Raises:
            ArgumentError: if the state belongs to other groups.
        """
        names = ("repeat", "group", "rounds")
        groups = dict(zip(names, [self._repeat, self._group, self._rounds], strict=True))
        require_same("sampler", dict(zip(names, state["groups"], strict=True)), groups)
        # Items are texts if the state was stored as JSON.
        out = {int(item): list(tickets) for item, tickets in state["out"].items()}
        self._out = defaultdict(list, out)
        self._came = {
            int(item): [answer and Answer(*answer) for answer in answers]
            for item, answers in state["came"].items()
        }
        self._forget()
        self._epoch = Epoch(list(state["drawn"]), state["place"])
        self._goes_on = bool(self._epoch.drawn)
        self._asked, self._trace, self._check = sum(map(len, self._out.values())), 0, 0

    def _ask(self) -> int:
        ticket, item = self._teacher.ask()
        self._out[item].append(ticket)
        self._asked += 1
        self._trace = crc32(b"%d " % item, self._trace)
        return int(item)

    def _forget(self) -> None:
        """Forgets tickets that are over, since a loader's state may be older than the teacher's."""
        for item, tickets in self._out.items():
            done = self._teacher.done_with(tickets)
            if done.any():
                tickets[:] = [t for t, over in zip(tickets, done, strict=True) if not over]
                self._came.pop(item, None)

    def _count(self, read: Callable[[], list[tuple[int, Answer | None]]]) -> None:
        """Adds answers, and tells the teacher the results of items whose last answer came."""
        came: dict[int, list[Answer | None]] = {}
        for item, answer in _everywhere(read, self._trace):
            came.setdefault(item, list(self._came.get(item, ()))).append(answer)
        groups: list[tuple[int, int, list[Answer]]] = []  # a ticket, its item, and the answers
        for item, answers in came.items():
            tickets = self._out.get(item, [])
            if len(answers) > len(tickets) * self._repeat:
                raise ArgumentError(
                    f"items={item}: {len(answers)} answers, but only {len(tickets) * self._repeat} "
                    "are out"
                )
            for ticket in tickets[: len(answers) // self._repeat]:
                group, answers[:] = answers[: self._repeat], answers[self._repeat :]
                groups.append((ticket, item, [one for one in group if one]))
        told = [ticket for ticket, _, results in groups if results]
        if told:
            whole = [(item, results) for _, item, results in groups if results]
            successes, returns, counts = zip(*(_mean(results) for _, results in whole), strict=True)
            predicted = self._teacher.predicted(told)
            self._teacher.tell(told, returns, successes, episodes=counts)
            for place, (item, results) in enumerate(whole):
                seen = {one.success for one in results}
                mixed = any(one.episodes > 1 and 0 < one.success < 1 for one in results)
                self._add(item, "success", successes[place])
                self._add(item, "yield", mixed or len(seen) > 1)
                if predicted is not None:
                    self._add(item, "predicted", float(predicted[place]))
        self._teacher.drop([ticket for ticket, _, results in groups if not results])
        for ticket, item, _ in groups:
            self._out[item].remove(ticket)
        self._came = {item: some for item, some in {**self._came, **came}.items() if some}
        self._look()

    def _add(self, item: int, name: str, value: float) -> None:
        """Adds a number of a group to the metrics."""
        for of in ("",) if self._sources is None else ("", f"/{self._sources[item]}"):
            total, number = self._sums.get(name + of, (0.0, 0))
            self._sums[name + of] = total + value, number + 1

    def _look(self) -> None:
        """Warns once if results of most items never come, when few can still be on their way."""
        if not self._check:
            self._check = max(4 * self._asked, FEW)
        if self._asked < self._check:
            return
        self._check = 2 * self._asked
        out = sum(map(len, self._out.values()))
        if 3 * out > self._asked:
            self._check = inf
            warnings.warn(
                f"{out} of {self._asked} items have no results yet: repeat, group and rounds must "
                "be those of the loop, and torch.distributed must be initialized on all ranks",
                stacklevel=4,
            )


def _everywhere(read: Callable[[], list[T]], trace: int) -> list[T]:
    """Returns what all ranks read, in their order; an error of one is raised by all."""
    try:
        mine, error = read(), ""
    except ArgumentError as refused:
        mine, error = [], str(refused)
    said = [(trace, error, mine)]
    if distributed.is_available() and distributed.is_initialized():
        said *= distributed.get_world_size()
        distributed.all_gather_object(said, said[0])
    if len({trace for trace, _, _ in said}) > 1:
        raise ArgumentError(
            "teacher: has drawn other items on other ranks; give all of them the same seed and "
            "state, and draw in step"
        )
    for _, error, _ in said:
        if error:
            raise ArgumentError(error)
    return [answer for _, _, answers in said for answer in answers]


def _answers(
    items: Any, success: Any, return_: Any, episodes: Any
) -> list[tuple[int, Answer | None]]:
    """Returns answers to items [n], each with its item."""
    numbers = as_ids("items", items).tolist()
    count = len(numbers)
    came = [True] * count
    if isinstance(success, list | tuple):
        came = [one is not None for one in success]

    def read(name: str, values: Any, *bounds: float, whole: bool = False) -> list[float]:
        if isinstance(values, list | tuple) and len(values) == len(came):
            values = [one if there else 1 for one, there in zip(values, came, strict=True)]
        found: list[float] = as_numbers(name, values, (count,), *bounds, whole=whole).tolist()
        return found

    shares = read("success", success, 0, 1)
    returns = shares if return_ is None else read("return_", return_)
    counts = [1.0] * count if episodes is None else read("episodes", episodes, 1, MOST, whole=True)
    answers = map(Answer, shares, returns, counts)
    each = zip(numbers, answers, came, strict=True)
    return [(item, answer if there else None) for item, answer, there in each]
