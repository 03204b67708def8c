"""A buffer of N levels, and functions that change it.

Prioritised level replay (Jiang et al. 2021, arXiv 2010.03934, section 3) keeps levels with a score
of how much there is to learn on them, and draws them again from

    P  =  (1 - staleness) w  +  staleness u,

w the *score weights* and u, which is proportional to the time since a level was last drawn or
scored, the *staleness weights*. A buffer is a tensordict [N] on the CPU:

- ``level``: the levels;
- ``filled`` bool: whether there is one; nothing else of an empty slot counts;
- ``score`` float64; ``best`` float32, the highest return that was ever seen on the level;
- ``reached`` float32, the return when the level was trained on last; else minus infinity;
- ``touched`` int64: the clock when it was drawn or scored last. A clock counts the levels that were
  drawn or scored; it is the entry ``clock``, the same in all slots;
- ``key`` int64: equal for equal levels; ``parent``: that of the level that it was edited from, 0
  for none; ``generation`` int64: edits since a level that was generated; ``draws`` int64.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import CPU, level_keys, moved
from proposer_rl.curricula.slots import Floats, draw_row, insert_row
from proposer_rl.settings import Count, Positive, Share, settings

Prioritization = Literal["rank", "proportional", "softmax"]


@settings
class ReplayRule:
    """The rule by which levels are drawn from a buffer.

    Attributes:
        prioritization: what the score weights depend on. ``rank``: r^(-1/T) of the r-th best score;
            ``proportional``: max(score, 0)^(1/T); ``softmax``: exp(score / T). Where all scores are
            equal, or no weight is above zero, all weights are equal.
        temperature: T; towards 0 the best level takes all, towards infinity all are alike.
        best: the number of levels with the highest scores that get weights at all; None for all.
        staleness: share of the draws that go by the time since the last one.
    """

    prioritization: Prioritization = "rank"
    temperature: Positive = 1.0
    best: Count | None = None
    staleness: Share = 0.3


def empty_buffer(level: Any, capacity: int) -> TensorDict:
    """Returns an empty buffer [capacity] for levels of the kind of the given one, []."""
    shape = (capacity,)
    numbers = ("touched", "clock", "key", "parent", "generation", "draws")
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
    """Returns the shares of the levels by their scores; they add up to 1 where there is any level.

    Args:
        score: float [*B, N].
        filled: bool [*B, N]; empty slots have no rank and no share.
        rule: of equal scores the earlier slot ranks first.

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
    """Returns the shares of the best score, the second best and so on: float64 [*B, N].

    Args:
        falling: the scores, float64 [*B, N].
        count: how many of them there are, int64 [*B, 1]; the others come last, and get none.
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
    """Returns r^(-1/T) of ranks r = 1 to ``count``, float64, which nobody may change."""
    return torch.arange(1, count + 1).double() ** (-1 / temperature)


def staleness_weights(age: Tensor, filled: Tensor) -> Tensor:
    """Returns shares in proportion to ages int64 [*B, N], equal ones if all ages are 0: float64."""
    weight = age.double().where(filled, 0.0)
    return _shares(weight.where(weight.sum(-1, keepdim=True) > 0, filled.double()))


def replay_weights(score: Tensor, age: Tensor, filled: Tensor, rule: ReplayRule) -> Tensor:
    """Returns the probability of each slot to be drawn: float64 [*B, N], zero for empty slots.

    Args:
        score: float [*B, N].
        age: int64 [*B, N], what the clock has advanced since a level was drawn or scored.
        filled: bool [*B, N].
        rule: of the draws.
    """
    by_score, by_age = score_weights(score, filled, rule), staleness_weights(age, filled)
    return (1 - rule.staleness) * by_score + rule.staleness * by_age


def draw_slots(
    buffer: TensorDictBase,
    count: int,
    rule: ReplayRule,
    generator: torch.Generator,
) -> Tensor:
    """Draws levels one after another: each draw advances the clock and makes its level fresh.

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
    slots = torch.from_numpy(draw_row(_numbers(entries), by_score, rule.staleness, noise))
    entries["draws"].scatter_add_(0, slots, torch.ones_like(slots))
    return slots


def insert(buffer: TensorDictBase, new: TensorDictBase, rule: ReplayRule) -> None:
    """Inserts levels that were scored, one after another.

    A level that is there already gets its new score. Another one gets the next free slot; where
    there is none, that of the level that is least likely to be drawn, if its score is higher than
    that one's. Equal levels among the new ones count once, with the mean of their scores.

    Args:
        buffer: [N].
        new: [M] with ``level``, ``score`` and ``best``, and where it is not zero ``parent`` and
            ``generation``; ``reached`` where they were trained on. Scores that are not finite are
            those of levels not to be kept.
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
        "draws": none,
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
    """Replaces the scores of levels that were drawn by new ones.

    Args:
        buffer: [N].
        slots: int64 [m]; of a slot that occurs several times the mean score counts.
        score: float [m]; one that is not finite leaves the level's old score.
        best: float [m], the highest returns, of which the highest ever is kept.
        reached: float [m], the returns, taken as scores are; None where nobody was trained.
    """
    new = {"score": score, **({} if reached is None else {"reached": reached})}
    for name, entry in new.items():
        there = buffer[name]
        there.copy_(_mean_of_slots(there, slots, entry))
    there = buffer["best"]
    there.scatter_reduce_(0, slots, best.to(there), "amax")


def lineage(buffer: TensorDictBase, most: int) -> Tensor:
    """Returns the slots of the longest line of levels, each edited from the one before: int64 [m].

    Args:
        buffer: [N].
        most: slots of the line, counted from its end, that are returned at most.
    """
    place = {key: slot for slot, key in enumerate(buffer["key"].tolist())}
    parents = [place.get(key) for key in buffer["parent"].tolist()]
    longest: list[int] = []
    for slot in range(len(parents)):
        line, parent = [slot], parents[slot]
        while parent is not None and parent not in line and len(line) < most:
            line.append(parent)
            parent = parents[parent]
        longest = max(longest, line, key=len)
    return torch.tensor(longest[::-1])


def _mean_of_slots(old: Tensor, slots: Tensor, new: Tensor) -> Tensor:
    """Returns for each slot the mean of what is new and finite in it, or its old value: [*B, N].

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
    """Gives equal levels one score, the mean of the finite ones, and one highest return: [M]."""
    groups, group = key.unique(return_inverse=True)
    unknown = torch.full((len(groups),), torch.nan, dtype=torch.float64)
    mean = _mean_of_slots(unknown, group, score)
    lowest = torch.full((len(groups),), -torch.inf, dtype=best.dtype)
    return mean[group], lowest.scatter_reduce(0, group, best, "amax")[group]


def _shares(weight: Tensor) -> Tensor:
    return weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
