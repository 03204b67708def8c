"""A buffer of N scored levels, and the functions that draw from it and change it.

Prioritised level replay (Jiang et al. 2021, arXiv 2010.03934, section 3) keeps levels with scores
of how much a student can learn on them, and draws them again from

    P  =  (1 - staleness) w  +  staleness u,

where w are the *score weights*, and the *staleness weights* u are proportional to the time since a
level was last drawn or scored. A buffer is a tensordict [N] on the CPU with these entries:

- ``level``: the levels;
- ``filled`` bool: whether the slot holds a level; other entries of an empty slot mean nothing;
- ``score`` float64; ``best`` float32: the highest return ever seen on the level;
- ``reached`` float32: the return when the level was last trained on, or minus infinity;
- ``touched`` int64: the clock when the level was last drawn or scored. The clock counts draws and
  scores; it is the entry ``clock``, the same in all slots;
- ``key`` int64: equal for equal levels only; ``parent``: the key of the level that was edited, 0
  for none; ``generation`` int64: number of edits since a generated level.

Slots are changed level by level, with NumPy, because a level is only a few numbers: ``numbers`` are
entries of the buffer by name, arrays [N] that are changed in place. A new score moves only the
ranks between the old place and the new one, so a level costs microseconds instead of a sort of all
N slots.

More than :data:`ONE_BY_ONE` levels, as thousands of environments ask for at once, are handled
together: all are drawn by the shares before the first of them, and the best new levels replace
those that are least likely to be drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import CPU, level_keys, moved
from proposer_rl.settings import Count, Positive, Share, settings

Prioritization = Literal["rank", "proportional", "softmax"]
Numbers = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float64]
Places = NDArray[np.int64]
Weigh = Callable[[Floats], Floats]
"""Shares by rank, adding up to one, of scores that fall."""

ONE_BY_ONE = 128


@settings
class ReplayRule:
    """Says how levels are drawn from a buffer.

    Attributes:
        prioritization: form of the score weights. ``rank``: r^(-1/T) of the r-th best score;
            ``proportional``: max(score, 0)^(1/T); ``softmax``: exp(score / T). If all scores are
            equal, or no weight is above zero, all weights are equal.
        temperature: T; towards 0 the best level takes all, towards infinity all are equal.
        best: number of levels with the highest scores that get any weight; None for all.
        staleness: share of the draws by the time since a level was last drawn or scored.
    """

    prioritization: Prioritization = "rank"
    temperature: Positive = 1.0
    best: Count | None = None
    staleness: Share = 0.3


def empty_buffer(level: Any, capacity: int) -> TensorDict:
    """Makes an empty buffer [capacity] for levels like the given one, []."""
    shape = (capacity,)
    numbers = ("touched", "clock", "key", "parent", "generation")
    return TensorDict(
        {
            "level": torch.zeros_like(level).cpu().expand(shape).clone(),
            "filled": torch.zeros(shape, dtype=torch.bool),
            "score": torch.zeros(shape, dtype=torch.float64),
            "best": torch.full(shape, -torch.inf),
            "reached": torch.full(shape, -torch.inf),
            **{name: torch.zeros(shape, dtype=torch.int64) for name in numbers},
        },
        shape,
    )


def score_weights(score: Tensor, filled: Tensor, rule: ReplayRule) -> Tensor:
    """Returns the shares of the levels by their scores; the sum is 1 unless all slots are empty.

    Args:
        score: float [*B, N].
        filled: bool [*B, N]; empty slots get no rank and no share.
        rule: of the draws; among equal scores the earlier slot ranks first.

    Returns:
        float64 [*B, N].

    Example:
        >>> score = torch.tensor([0.9, 0.1, 0.5, 0.5, -0.2])
        >>> score_weights(score, score < 1, ReplayRule(temperature=1.0))
        tensor([0.4380, 0.1095, 0.2190, 0.1460, 0.0876], dtype=torch.float64)
    """
    known = score.double().where(filled, -torch.inf)
    falling, order = known.sort(dim=-1, descending=True, stable=True)
    shares = shares_by_rank(falling, filled.sum(-1, keepdim=True), rule)
    return torch.zeros_like(shares).scatter_(-1, order, shares)


def shares_by_rank(falling: Tensor, count: Tensor, rule: ReplayRule) -> Tensor:
    """Returns the shares of scores in falling order: float64 [*B, N].

    Args:
        falling: the scores, float64 [*B, N].
        count: number of real scores, int64 [*B, 1]; the rest come last and get no share.
        rule: of the draws.
    """
    rank = torch.arange(1, falling.shape[-1] + 1)
    exists = rank <= count
    counted = exists if rule.best is None else exists & (rank <= rule.best)
    if rule.prioritization == "rank":
        weight = _by_rank(len(rank), rule.temperature)
    elif rule.prioritization == "proportional":
        # Divided by the largest, so that no power of it is infinite.
        largest = falling[..., :1].clamp_min(torch.finfo(falling.dtype).tiny)
        weight = (falling / largest).clamp_min(0) ** (1 / rule.temperature)
    else:
        logits = falling.where(counted, -torch.inf) / rule.temperature
        weight = (logits - logits[..., :1]).exp()
    weight = weight.where(counted, 0.0)
    lowest = falling.gather(-1, (count - 1).clamp_min(0))
    alike = (falling[..., :1] == lowest) | (weight.sum(-1, keepdim=True) == 0)
    return _shares(weight.where(~alike, exists.double()))


@lru_cache(8)
def _by_rank(count: int, temperature: float) -> Tensor:
    """Returns r^(-1/T) of the ranks r = 1 to ``count``, float64. Shared: do not change it."""
    return torch.arange(1, count + 1).double() ** (-1 / temperature)


def replay_weights(score: Tensor, age: Tensor, filled: Tensor, rule: ReplayRule) -> Tensor:
    """Returns the probability that each slot is drawn, 0 for empty slots: float64 [*B, N].

    Args:
        score: float [*B, N].
        age: int64 [*B, N], by how much the clock has advanced since a level was drawn or scored.
        filled: bool [*B, N].
        rule: of the draws.
    """
    stale = age.double().where(filled, 0.0)
    by_age = _shares(stale.where(stale.sum(-1, keepdim=True) > 0, filled.double()))
    return (1 - rule.staleness) * score_weights(score, filled, rule) + rule.staleness * by_age


def draw_slots(
    buffer: TensorDictBase, count: int, rule: ReplayRule, generator: torch.Generator
) -> Tensor:
    """Draws levels one after another; each draw advances the clock and resets the age of its level.

    Args:
        buffer: with a level in some slot.
        count: number n of draws.
        rule: of the draws.
        generator: of the CPU.

    Returns:
        Slots int64 [n].
    """
    entries = dict(buffer.items())
    by_score = score_weights(entries["score"], entries["filled"], rule).numpy()
    noise = torch.rand(count, generator=generator, dtype=torch.float64).numpy()
    return torch.from_numpy(draw_row(_numbers(entries), by_score, rule.staleness, noise))


def insert(buffer: TensorDictBase, new: TensorDictBase, rule: ReplayRule) -> None:
    """Inserts scored levels one after another.

    A level that the buffer already holds gets its new score. Any other level takes the next free
    slot. If there is none, it replaces the level that is least likely to be drawn, provided that
    its score is higher. Equal levels among the new ones count once, with the mean of their scores.

    Args:
        buffer: [N].
        new: [M] with ``level``, ``score`` and ``best``; edited levels also have ``parent`` and
            ``generation``, and levels that were trained on ``reached``. A level whose score is not
            finite is not kept.
        rule: of the draws.
    """

    def weigh(falling: Floats) -> Floats:
        count = torch.tensor([len(falling)])
        return shares_by_rank(torch.from_numpy(falling), count, rule).numpy()

    entries, fresh = dict(buffer.items()), dict(new.items())
    keys = level_keys(fresh["level"])
    score, best = _of_equals(keys, fresh["score"], fresh["best"])
    given = _numbers(entries), keys.numpy(), score.numpy(), rule.staleness, weigh
    by_rank = rule.prioritization == "rank"
    source, again = map(torch.from_numpy, insert_row(*given, by_rank))
    there = entries["best"]
    there.scatter_reduce_(0, again[0], best[again[1]].to(there), "amax")
    slots = (source >= 0).nonzero().flatten()
    which = source[slots]
    none = torch.zeros_like(keys)
    kept = {
        "best": best,
        "parent": fresh.get("parent", none),
        "generation": fresh.get("generation", none),
        "reached": fresh.get("reached", torch.full(keys.shape, -torch.inf)),
    }
    for name, entry in kept.items():
        entries[name][slots] = entry[which].to(entries[name])
    entries["level"][slots] = moved(fresh["level"][which], CPU)


def rescore(
    buffer: TensorDictBase,
    slots: Tensor,
    score: Tensor,
    best: Tensor,
    reached: Tensor | None = None,
) -> None:
    """Replaces the scores of levels that were drawn.

    Args:
        buffer: [N].
        slots: int64 [m]; a slot that occurs several times gets the mean of its scores.
        score: float [m]; a score that is not finite leaves the old one in place.
        best: float [m], the highest returns; the buffer keeps the highest ever.
        reached: float [m], the returns, treated like scores; None if the levels were only played.
    """
    new = {"score": score, **({} if reached is None else {"reached": reached})}
    for name, entry in new.items():
        there = buffer[name]
        there.copy_(_mean_of_slots(there, slots, entry))
    there = buffer["best"]
    there.scatter_reduce_(0, slots, best.to(there), "amax")


def _mean_of_slots(old: Tensor, slots: Tensor, new: Tensor) -> Tensor:
    """Returns the mean of the finite new values of each slot, or else its old value: [*B, N].

    Args:
        old: values of all slots, [*B, N].
        slots: int64 [*B, P].
        new: values for these, float [*B, P].
    """
    finite, none = new.isfinite(), torch.zeros_like(old, dtype=torch.float64)
    counts = none.scatter_add(-1, slots, finite.double())
    means = none.scatter_add(-1, slots, new.double().where(finite, 0.0)) / counts
    return means.to(old).where(counts > 0, old)


def _numbers(entries: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the numbers of a buffer as arrays [N] that share its memory."""
    names = ("filled", "score", "key", "touched", "clock")
    return {name: entries[name].numpy() for name in names}


def _of_equals(key: Tensor, score: Tensor, best: Tensor) -> tuple[Tensor, Tensor]:
    """Gives equal levels the mean of their finite scores, and their highest return: [M]."""
    groups, group = key.unique(return_inverse=True)
    unknown = torch.full((len(groups),), torch.nan, dtype=torch.float64)
    mean = _mean_of_slots(unknown, group, score)
    lowest = torch.full((len(groups),), -torch.inf, dtype=best.dtype)
    return mean[group], lowest.scatter_reduce(0, group, best, "amax")[group]


def _shares(weight: Tensor) -> Tensor:
    return weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)


def draw_row(
    numbers: Numbers, by_score: Floats, staleness: float, noise: Floats
) -> NDArray[np.int64]:
    """Draws slots one after another; each draw advances the clock and resets the age of its level.

    Args:
        numbers: of a buffer that holds a level.
        by_score: shares of the slots by their scores, [N].
        staleness: share of the draws by age.
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
    """Keeps the slots in order of falling score, with their shares; ties go to the earlier slot.

    Args:
        score: of all slots, [N]; :meth:`change` changes it in place.
        weigh: returns shares by rank.
        by_rank: whether the shares depend on ranks alone, as long as two scores differ.
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
        """Changes the score of a slot and renews the shares."""
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
        """Returns how many slots rank before a slot with this score."""
        first = int(self._falling.searchsorted(-score, "left"))
        last = int(self._falling.searchsorted(-score, "right"))
        return first + int(self._slots[first:last].searchsorted(slot))


def insert_row(
    numbers: Numbers, keys: Places, scores: Floats, staleness: float, weigh: Weigh, by_rank: bool
) -> tuple[Places, Places]:
    """Inserts levels into slots, one after another, or all at once if there are many.

    Changes ``filled``, ``key``, ``score``, ``touched`` and ``clock``.

    Args:
        numbers: of the buffer.
        keys: of the new levels, [M].
        scores: of the new levels; levels without a finite score are not kept.
        staleness: share of the draws by age.
        weigh: returns shares by rank of falling scores.
        by_rank: see :class:`Ranks`.

    Returns:
        Which new level each slot received, int64 [N], -1 for none; and slots and numbers of new
        levels that the buffer already held, int64 [2, m].
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
                slot = int(_by_both(ranks.shares, clock - touched, staleness).argmin())
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
        shares = _by_both(by_score, clock + len(keys) - touched[used], staleness)
        least = np.argpartition(shares, more - 1)[:more]
        slots = np.concatenate([slots, used[least[np.argsort(shares[least], kind="stable")]]])
    new, slots = new[: len(slots)], slots[: len(new)]
    better = ~filled[slots] | (scores[new] > score[slots])
    new, slots = new[better], slots[better]
    filled[slots], key[slots], source[slots] = True, keys[new], new
    score[slots], touched[slots] = scores[new], clock + 1 + new
    return source, again


def _by_both(by_score: Floats, age: Places, staleness: float) -> Floats:
    """Returns the shares by score and age of slots that all hold a level: [N]."""
    return by_score * (1 - staleness) + age * (staleness / max(int(age.sum()), 1))
