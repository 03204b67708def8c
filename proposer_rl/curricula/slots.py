"""The slots of a buffer, changed level by level: NumPy, since a level is a few numbers.

``numbers`` are the entries of a buffer by name, arrays [N] that are changed in place; see
:mod:`~proposer_rl.curricula.buffer`. Scores only move the ranks between the old place and the new,
so that a level costs microseconds and not another sort of all N.

More than :data:`ONE_BY_ONE` levels, as thousands of environments ask for them, are simultaneous:
all are drawn by the shares before the first of them, and the best new ones take the places of the
levels that are least likely to be drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Numbers = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float64]
Places = NDArray[np.int64]
Weigh = Callable[[Floats], Floats]
"""Shares by rank, adding up to one, of scores that fall."""

ONE_BY_ONE = 128


def draw_row(
    numbers: Numbers, by_score: Floats, staleness: float, noise: Floats
) -> NDArray[np.int64]:
    """Draws slots one after another; each draw advances the clock and makes its level fresh.

    Args:
        numbers: of a row with a level.
        by_score: shares of the slots by their scores, [N].
        staleness: share of the draws that go by age.
        noise: uniform in [0, 1), [P].

    Returns:
        The slots, int64 [P].
    """
    touched, filled = numbers["touched"], numbers["filled"]
    clock, last = int(numbers["clock"][0]), len(filled) - 1
    by_score = (1 - staleness) * by_score.cumsum()
    count = filled.cumsum().astype(np.float64)
    ages = ((clock - touched) * filled).cumsum().astype(np.float64)  # whole numbers
    slots, shares = np.empty(len(noise), np.int64), np.empty_like(count)
    some = 1 if len(noise) <= ONE_BY_ONE else len(noise)
    for start in range(0, len(noise), some):
        marks = noise[start : start + some]
        old = ages if ages[-1] > 0 else count
        np.multiply(old, staleness / old[-1], out=shares)
        shares += by_score
        # An empty slot adds nothing to the sum, so that no mark lies in it.
        which = np.minimum(shares.searchsorted(marks * shares[-1], "right"), last)
        slots[start : start + some] = which
        ages += count
        ages[which[0] :] -= clock + 1 - touched[which[0]]
        touched[which] = clock + np.arange(1, some + 1)
        clock += some
    numbers["clock"][:] = clock
    return slots


class Ranks:
    """The slots by falling score, of equal scores the earlier slot first, and their shares.

    Args:
        score: of all slots, [N], which :meth:`change` changes.
        weigh: shares by rank.
        by_rank: whether these are the same whatever the scores are, as long as two of them differ.
    """

    def __init__(self, score: Floats, weigh: Weigh, by_rank: bool) -> None:
        self._score, self._weigh, self._by_rank = score, weigh, by_rank
        self._slots = np.argsort(-score, kind="stable")
        self._falling = -score[self._slots]  # rising, as searchsorted takes it
        self._table = weigh(-self._falling)
        self._uniform = self._falling[0] == self._falling[-1]
        self.shares = np.empty_like(self._table)
        self.shares[self._slots] = self._table

    def change(self, slot: int, score: float) -> None:
        """Gives a slot another score, and renews the shares."""
        old = self._place(slot, self._score[slot])
        new = self._place(slot, score)
        new -= new > old  # its own place does not count
        for line, value in ((self._slots, slot), (self._falling, -score)):
            if new < old:
                line[new + 1 : old + 1] = line[new:old]
            else:
                line[old:new] = line[old + 1 : new + 1]
            line[new] = value
        self._score[slot] = score
        uniform = self._falling[0] == self._falling[-1]
        if self._by_rank and not uniform and not self._uniform:
            moved = slice(min(old, new), max(old, new) + 1)
        else:
            self._table, moved = self._weigh(-self._falling), slice(None)
        self.shares[self._slots[moved]] = self._table[moved]
        self._uniform = uniform

    def _place(self, slot: int, score: float) -> int:
        """Returns how many slots are before one with this score."""
        first = int(self._falling.searchsorted(-score, "left"))
        last = int(self._falling.searchsorted(-score, "right"))
        return first + int(self._slots[first:last].searchsorted(slot))


def insert_row(
    numbers: Numbers, keys: Places, scores: Floats, staleness: float, weigh: Weigh, by_rank: bool
) -> tuple[Places, Places]:
    """Inserts levels into the slots of a row, one after another or many of them at once.

    Changes ``filled``, ``key``, ``score``, ``touched`` and ``clock``.

    Args:
        numbers: of the row.
        keys: of the new levels, [M].
        scores: of them; one that is not finite is not kept.
        staleness: share of the draws that go by age.
        weigh: shares by rank of scores that fall.
        by_rank: see :class:`Ranks`.

    Returns:
        Which new level has gone into each slot, int64 [N], -1 for none; and slots and levels of
        those that were there already, int64 [2, m].
    """
    if len(keys) > ONE_BY_ONE:
        return _insert_at_once(numbers, keys, scores, staleness, weigh)
    filled, key, score, touched = (numbers[n] for n in ("filled", "key", "score", "touched"))
    clock = int(numbers["clock"][0])
    place = dict(zip(key[filled].tolist(), filled.nonzero()[0].tolist(), strict=True))
    free = iter((~filled).nonzero()[0].tolist())
    source, again = np.full(len(filled), -1), []
    ranks: Ranks | None = None
    for i, (own, value) in enumerate(zip(keys.tolist(), scores.tolist(), strict=True)):
        clock += 1
        if not math.isfinite(value):
            continue
        slot = place.get(own, -1)
        if slot >= 0:
            again.append((slot, i))
        else:
            slot = next(free, -1)
            if slot < 0:
                ranks = ranks or Ranks(score, weigh, by_rank)
                slot = int(_shares(ranks.shares, clock - touched, staleness).argmin())
                if not value > score[slot]:
                    continue
                del place[int(key[slot])]
            filled[slot], key[slot], source[slot] = True, own, i
            place[own] = slot
        if ranks is None:
            score[slot] = value
        else:
            ranks.change(slot, value)
        touched[slot] = clock
    numbers["clock"][:] = clock
    return source, np.array(again, np.int64).reshape(-1, 2).T


def _insert_at_once(
    numbers: Numbers, keys: Places, scores: Floats, staleness: float, weigh: Weigh
) -> tuple[Places, Places]:
    """Inserts many levels at once, the best first."""
    filled, key, score, touched = (numbers[n] for n in ("filled", "key", "score", "touched"))
    clock, source = int(numbers["clock"][0]), np.full(len(filled), -1)
    numbers["clock"][:] = clock + len(keys)
    finite = np.flatnonzero(np.isfinite(scores))[::-1]
    if not len(finite):
        return source, np.empty((2, 0), np.int64)
    own, last = np.unique(keys[finite], return_index=True)  # of equal ones the last
    new, used = finite[last], np.flatnonzero(filled)
    place = own.searchsorted(key[used]).clip(max=len(own) - 1)
    there = own[place] == key[used]
    again = np.stack([used[there], new[place[there]]])
    score[again[0]], touched[again[0]] = scores[again[1]], clock + 1 + again[1]
    new = np.delete(new, place[there])
    new = new[np.argsort(-scores[new], kind="stable")]
    slots = np.flatnonzero(~filled)
    more = min(len(new) - len(slots), len(used))
    if more > 0:
        by_score = Ranks(score[used], weigh, by_rank=False).shares
        shares = _shares(by_score, clock + len(keys) - touched[used], staleness)
        least = np.argpartition(shares, more - 1)[:more]
        slots = np.concatenate([slots, used[least[np.argsort(shares[least], kind="stable")]]])
    new, slots = new[: len(slots)], slots[: len(new)]
    better = ~filled[slots] | (scores[new] > score[slots])
    new, slots = new[better], slots[better]
    filled[slots], key[slots], source[slots] = True, keys[new], new
    score[slots], touched[slots] = scores[new], clock + 1 + new
    return source, again


def _shares(by_score: Floats, age: Places, staleness: float) -> Floats:
    """Returns the shares that slots are drawn by, where there is a level in each: [N]."""
    return by_score * (1 - staleness) + age * (staleness / max(int(age.sum()), 1))
