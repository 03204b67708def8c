"""Curricula over data sets: a sampler of items whose results come back later."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from math import inf
from typing import Any, NamedTuple, TypeVar
from zlib import crc32

import torch
from torch import Tensor, distributed
from torch.utils.data import Sampler

from proposer_rl.settings import ArgumentError, Count, checked
from proposer_rl.teaching.numbers import as_ids, as_numbers
from proposer_rl.teaching.results import MOST
from proposer_rl.teaching.spaces import Items
from proposer_rl.teaching.teacher import Teacher

T = TypeVar("T")

FEW = 32  # items of which it is too early to say that most are missing


class Answer(NamedTuple):
    """The result of an item: success and return of an answer, or the means of several."""

    success: float
    return_: float
    episodes: float = 1


@dataclass
class Epoch:
    """The items drawn in an epoch, and how many were given to the loop, with repetitions."""

    drawn: list[int] = field(default_factory=list)
    place: int = 0


class TeacherSampler(Sampler[int]):
    """Samples items that a teacher proposes, for any loader; results are reported by item.

    Each item is out until ``repeat`` answers to it have come back, in any order and over any number
    of calls; the teacher gets their means.

    In a launch of several ranks every rank makes the same teacher and the same sampler, draws from
    it in step with the others, and reports the results of its own part. :meth:`tell` and
    :meth:`drop` gather those of all ranks, where ``torch.distributed`` is initialized, so that all
    teachers stay the same.

    Importing TorchRL makes processes spawn: a script whose loader has workers needs its
    ``if __name__ == "__main__":``.

    Args:
        teacher: of :class:`Items`.
        length: items of an epoch.
        repeat: how many times each comes, one after another, as groups of answers to one prompt.
        group: items that are repeated together before they come again; with ``rounds``.
        rounds: how many times each group comes over again.
        sources: where each item is from, [N], by which :meth:`metrics` are given, too.

    Raises:
        ArgumentError: if the teacher's levels are no items, or not each has a source.
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
        count = items_of(teacher).size
        if sources is not None and len(sources) != count:
            raise ArgumentError(f"sources: {len(sources)} for {count} items")
        self._teacher, self._length = teacher, length
        self._repeat, self._group, self._rounds = repeat, group, rounds
        self._out: dict[int, list[int]] = defaultdict(list)  # tickets of each item
        # Answers to items of which more are to come.
        self._came: dict[int, list[Answer | None]] = {}
        self._epoch, self._goes_on = Epoch(), False  # whether the next one is the rest of it
        self._asked, self._trace = 0, 0  # how many items since the start, and a checksum of them
        self._check: float = 0  # how many there must be for the next look at what is missing
        self._sources = sources
        self._sums: dict[str, list[float]] = {}  # since the last metrics, of all and by source

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
        """Gives the items of this epoch again from its first one, before any new ones.

        For loops that skip what they have had, as with accelerate's ``skip_first_batches``.
        """
        self._epoch.place, self._goes_on = 0, True

    def tell(
        self, items: Sequence[int], success: Any, return_: Any = None, *, episodes: Any = None
    ) -> None:
        """Reports results of items; each counts when its last answer is there.

        Args:
            items: as they were drawn, with their repetitions, in any order, [n].
            success: of each answer, from 0 to 1; None for one of which nothing came, [n].
            return_: of each; None for the success.
            episodes: how many answers each is the mean of, where ``repeat`` is 1; None for one.

        Raises:
            ArgumentError: for an item of which not so many answers are out, or another number of
                results; none of them counts then, on any rank.
        """
        self._count(lambda: _answers(items, success, return_, episodes))

    def drop(self, items: Sequence[int] | None = None) -> None:
        """Gives up items of which no results will come.

        Args:
            items: see :meth:`tell`; None for all that are out, where a resumed loop begins an
                epoch anew.
        """
        if items is None:
            self._teacher.drop([*chain.from_iterable(self._out.values())])
            self._out.clear()
            self._came.clear()
            self._epoch, self._goes_on = Epoch(), False
        else:
            self._count(lambda: [(item, None) for item in as_ids("items", items).tolist()])

    def metrics(self) -> dict[str, float]:
        """Returns means over the groups that were complete since the last call.

        ``success``; what the curriculum had ``predicted`` of it, if it has a belief; ``yield``, the
        share of groups whose answers differ, of which a mean between 0 and 1 is taken for one;
        ``no_variance``, that of all others; and the same by source, as ``yield/SOURCE``. Nothing
        if there was no group.
        """
        shown: dict[str, float] = {}
        for of, (groups, success, mixed, predicted, known) in self._sums.items():
            shown |= {f"success{of}": success / groups, f"yield{of}": mixed / groups}
            shown[f"no_variance{of}"] = 1 - mixed / groups
            if known:
                shown[f"predicted{of}"] = predicted / known
        self._sums = {}
        return shown

    def state_dict(self) -> dict[str, Any]:
        """Returns what is out, and the place in the epoch; the teacher has a state of its own."""
        return {
            "groups": [self._repeat, self._group, self._rounds],
            "out": {item: list(tickets) for item, tickets in self._out.items() if tickets},
            # torch.load(weights_only=True) takes tuples, none that have names.
            "came": {i: [one and tuple(one) for one in each] for i, each in self._came.items()},
            "drawn": list(self._epoch.drawn),
            "place": self._epoch.place,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Puts back a state; the next epoch is the rest of the one that was begun.

        Raises:
            ArgumentError: if it is of other groups.
        """
        groups = [self._repeat, self._group, self._rounds]
        if list(state["groups"]) != groups:
            raise ArgumentError(
                f"state: of [repeat, group, rounds] = {list(state['groups'])}, not {groups}"
            )
        self._out = defaultdict(list)  # JSON has made texts of the items
        self._out.update({int(item): list(tickets) for item, tickets in state["out"].items()})
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
        """Forgets what the teacher has done with, as a loader's state may be older than its own."""
        for item, tickets in self._out.items():
            done = self._teacher.done_with(tickets)
            if done.any():
                tickets[:] = [t for t, over in zip(tickets, done, strict=True) if not over]
                self._came.pop(item, None)

    def _count(self, read: Callable[[], list[tuple[int, Answer | None]]]) -> None:
        """Counts answers, and gives the teacher the results of items whose last answer came."""
        came: dict[int, list[Answer | None]] = {}
        for item, answer in _everywhere(read, self._trace):
            came.setdefault(item, list(self._came.get(item, ()))).append(answer)
        whole: list[tuple[int, float, float, float]] = []
        groups: list[tuple[int, list[Answer]]] = []  # the answers of each of them
        dropped: list[int] = []
        over: list[tuple[int, int]] = []  # items, and how many of their tickets
        for item, answers in came.items():
            tickets = self._out.get(item, [])
            if len(answers) > len(tickets) * self._repeat:
                often = f" {len(answers)} times" if tickets else ""
                raise ArgumentError(f"items={item}: is not out{often}")
            full = len(answers) // self._repeat
            for ticket in tickets[:full]:
                group, answers[:] = answers[: self._repeat], answers[self._repeat :]
                if results := [Answer(*answer) for answer in group if answer]:
                    episodes = sum(one.episodes for one in results)
                    return_ = sum(one.return_ * one.episodes for one in results) / episodes
                    success = sum(one.success * one.episodes for one in results) / episodes
                    whole.append((ticket, return_, success, episodes))
                    groups.append((item, results))
                else:
                    dropped.append(ticket)
            over.append((item, full))
        if whole:
            ids, returns, successes, counts = zip(*whole, strict=True)
            predicted = self._teacher.predicted([*ids])
            self._teacher.tell([*ids], returns, successes, episodes=counts)
            for place, (item, results) in enumerate(groups):
                expected = None if predicted is None else float(predicted[place])
                self._sum(item, successes[place], results, expected)
        self._teacher.drop(dropped)
        for item, full in over:
            del self._out[item][:full]
        self._came.update(came)
        for item in [item for item in came if not came[item]]:
            del self._came[item]
        self._look()

    def _sum(
        self, item: int, success: float, results: list[Answer], predicted: float | None
    ) -> None:
        """Adds a group to the metrics."""
        seen = {one.success for one in results}
        mixed = len(seen) > 1 or any(one.episodes > 1 and 0 < one.success < 1 for one in results)
        known = predicted is not None
        for of in [""] if self._sources is None else ["", f"/{self._sources[item]}"]:
            sums = self._sums.setdefault(of, [0.0] * 5)
            for place, value in enumerate((1, success, mixed, predicted or 0, known)):
                sums[place] += value

    def _look(self) -> None:
        """Warns, once, if results of most items never come, when few can still be on their way."""
        if not self._check:
            self._check = max(4 * self._asked, FEW)
        if self._asked < self._check:
            return
        self._check = 2 * self._asked
        out = sum(map(len, self._out.values()))
        if 3 * out > self._asked:
            self._check = inf
            warnings.warn(
                f"results of {out} of {self._asked} items have not come back: repeat, group and "
                "rounds must be the loop's, and torch.distributed initialized on all ranks",
                stacklevel=4,
            )


class MixedGroups(NamedTuple):
    """Groups whose answers differ, and what they have cost.

    Attributes:
        items: of the groups, [m].
        success: of their answers, float64 [m, G].
        places: of the groups among all that were generated, one call after another, int64 [m].
        rollouts: answers that were generated, those of groups that were thrown away among them.
    """

    items: list[int]
    success: Tensor
    places: Tensor
    rollouts: int


@checked
def mixed_groups(
    teacher: Teacher, count: Count, generate: Callable[[list[int]], Any], *, most: Count = 10
) -> MixedGroups:
    """Draws items until enough groups of answers are mixed, as in DAPO's dynamic sampling.

    GRPO learns nothing from a group whose answers are all alike. The teacher draws another item in
    its place; its result counts for the curriculum like all others.

    Args:
        teacher: of :class:`Items`, with a ``block`` of about ``count``.
        count: how many groups are to be mixed.
        generate: of items [n] the success of G answers to each, from 0 to 1, [n, G].
        most: calls of it, after which there may be fewer groups.

    Raises:
        ArgumentError: if its results are no such numbers, or G is 1 or another than before, whose
            items are dropped then; if the teacher's levels are no items.
    """
    items_of(teacher)
    drawn: list[int] = []
    groups: list[Tensor] = []
    places: list[int] = []
    rollouts = 0
    for _ in range(most):
        tickets, items = teacher.ask(count - len(places))
        try:
            given = as_numbers("generate", generate(items.tolist()), (len(items), None), 0, 1)
            success = torch.from_numpy(given)
            size = success.shape[1]
            if size < 2 or (groups and size != groups[0].shape[1]):
                before = f", first {groups[0].shape[1]}" if groups else ""
                raise ArgumentError(
                    f"generate: must give groups of one size from 2, got {size}{before}"
                )
            means = success.mean(1)
            teacher.tell(tickets, means, means, episodes=success.shape[1])
        except BaseException:
            teacher.drop(tickets)
            raise
        mixed = (success != success[:, :1]).any(1).nonzero().flatten()
        places += (mixed + len(drawn)).tolist()
        drawn += items.tolist()
        groups.append(success)
        rollouts += success.numel()
        if len(places) == count:
            break
    chosen = torch.tensor(places, dtype=torch.int64)
    return MixedGroups(
        [drawn[place] for place in places], torch.cat(groups)[chosen], chosen, rollouts
    )


def items_of(teacher: Teacher) -> Items:
    """Returns the items that a teacher proposes.

    Raises:
        ArgumentError: if its levels are no items.
    """
    if not isinstance(teacher.space, Items):
        raise ArgumentError("teacher: must have a space of Items")
    return teacher.space


def _everywhere(read: Callable[[], list[T]], trace: int) -> list[T]:
    """Returns what all ranks read, rank by rank; what one refuses is refused by all."""
    try:
        mine, error = read(), ""
    except ArgumentError as refused:
        mine, error = [], str(refused)
    said = [(trace, error, mine)]
    if distributed.is_available() and distributed.is_initialized():
        said *= distributed.get_world_size()
    if len(said) > 1:
        distributed.all_gather_object(said, said[0])
    if len({trace for trace, _, _ in said}) > 1:
        raise ArgumentError(
            "teacher: has drawn other items on other ranks; each needs the same seed and state, "
            "and must draw in step"
        )
    for _, error, _ in said:
        if error:
            raise ArgumentError(error)
    return [answer for _, _, answers in said for answer in answers]


def _answers(
    items: Any, success: Any, return_: Any, episodes: Any
) -> list[tuple[int, Answer | None]]:
    """Returns the answers to items [n], each with its item."""
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
