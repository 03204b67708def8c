"""A buffer of N levels for each of K Solvers, as pure functions of tensors.

Prioritised level replay (Jiang et al. 2021, arXiv 2010.03934, section 3) keeps levels with a score
of how much there is to learn on them, and draws them again from

    P  =  (1 - staleness) w  +  staleness u,

w the *score weights* and u, which is proportional to the time since a level was last drawn or
scored, the *staleness weights*. A buffer is a tensordict [K, N] on the CPU:

- ``level``: the levels;
- ``filled`` bool: whether there is one; nothing else of an empty slot counts;
- ``score`` float64; ``best`` float32, the highest return that was ever seen on the level, and
  ``solved`` bool, whether an episode there ever was a success;
- ``touched`` int64: the clock when it was drawn or scored last. A clock counts the levels that were
  drawn or scored; it is the entry ``clock``, the same in all slots;
- ``key`` int64: equal for equal levels; ``parent``: that of the level that it was edited from, 0
  for none; ``generation`` int64: edits since a level that was generated; ``draws`` int64.

Functions return a changed copy and leave the buffer that they are given as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.settings import Count, Positive, Share, settings

Prioritization = Literal["rank", "proportional", "softmax"]

SEEN = ("best", "solved")  # entries that never fall


@settings
class ReplayRule:
    """How levels are drawn from a buffer.

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


def empty_buffer(level: Any, copies: int, capacity: int) -> TensorDict:
    """A buffer [K, N] without levels.

    Args:
        level: one, [], of the kind that it is to hold.
        copies: K.
        capacity: N.
    """
    shape = (copies, capacity)
    numbers = ("touched", "clock", "key", "parent", "generation", "draws")
    return TensorDict(
        {
            "level": torch.zeros_like(level).cpu().expand(shape).clone(),
            "filled": torch.zeros(shape, dtype=torch.bool),
            "score": torch.zeros(shape, dtype=torch.float64),
            "best": torch.full(shape, -torch.inf),
            "solved": torch.zeros(shape, dtype=torch.bool),
            **{name: torch.zeros(shape, dtype=torch.int64) for name in numbers},
        },
        shape,
    )


def score_weights(score: Tensor, filled: Tensor, rule: ReplayRule) -> Tensor:
    """Shares of the levels by their scores, adding up to 1 where there is any level.

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
    score = score.double()
    known = score.where(filled, -torch.inf)
    order = known.argsort(dim=-1, descending=True, stable=True)
    rank = torch.empty_like(order).scatter_(
        -1, order, torch.arange(1, score.shape[-1] + 1).expand_as(order)
    )
    counted = filled if rule.best is None else filled & (rank <= rule.best)
    if rule.prioritization == "rank":
        weight = rank.double() ** (-1 / rule.temperature)
    elif rule.prioritization == "proportional":
        # Divided by the largest, so that no power of it is infinite.
        largest = known.amax(-1, keepdim=True).clamp_min(torch.finfo(score.dtype).tiny)
        weight = (known / largest).clamp_min(0) ** (1 / rule.temperature)
    else:
        logits = known.where(counted, -torch.inf) / rule.temperature
        weight = (logits - logits.amax(-1, keepdim=True)).exp()
    weight = weight.where(counted, 0.0)
    lowest = score.where(filled, torch.inf).amin(-1, keepdim=True)
    alike = (known.amax(-1, keepdim=True) == lowest) | (weight.sum(-1, keepdim=True) == 0)
    return _shares(weight.where(~alike, filled.double()))


def staleness_weights(age: Tensor, filled: Tensor) -> Tensor:
    """Shares in proportion to ages int64 [*B, N], all alike where all ages are 0: float64."""
    weight = age.double().where(filled, 0.0)
    return _shares(weight.where(weight.sum(-1, keepdim=True) > 0, filled.double()))


def replay_weights(score: Tensor, age: Tensor, filled: Tensor, rule: ReplayRule) -> Tensor:
    """The distribution that levels are drawn from: float64 [*B, N], zero for empty slots.

    Args:
        score: float [*B, N].
        age: int64 [*B, N], what the clock has advanced since a level was drawn or scored.
        filled: bool [*B, N].
        rule: of the draws.
    """
    by_score, by_age = score_weights(score, filled, rule), staleness_weights(age, filled)
    return (1 - rule.staleness) * by_score + rule.staleness * by_age


def draw_slots(
    buffer: TensorDictBase, count: int, rule: ReplayRule, generators: Sequence[torch.Generator]
) -> tuple[Tensor, TensorDict]:
    """Draw levels one after another: each draw advances the clock and makes its level fresh.

    Args:
        buffer: with a level in some slot of every copy.
        count: number P of draws.
        rule: of the draws.
        generators: one for each copy.

    Returns:
        Slots int64 [K, P], and the buffer afterwards.
    """
    filled, by_score = buffer["filled"], score_weights(buffer["score"], buffer["filled"], rule)
    touched, clock = buffer["touched"].clone(), buffer["clock"].clone()
    noise = torch.stack([torch.rand(count, generator=g, dtype=torch.float64) for g in generators])
    slots = torch.empty(noise.shape, dtype=torch.int64)
    for i in range(count):
        by_age = staleness_weights(clock - touched, filled)
        cumulative = ((1 - rule.staleness) * by_score + rule.staleness * by_age).cumsum(-1)
        mark = noise[:, i : i + 1] * cumulative[:, -1:]
        # An empty slot adds nothing to the sum, so that no mark lies in it.
        slot = torch.searchsorted(cumulative, mark, right=True).clamp_(max=filled.shape[-1] - 1)
        clock += 1
        touched.scatter_(1, slot, clock.gather(1, slot))
        slots[:, i : i + 1] = slot
    draws = buffer["draws"].scatter_add(1, slots, torch.ones_like(slots))
    return slots, _changed(buffer, touched=touched, clock=clock, draws=draws)


def insert(
    buffer: TensorDictBase, new: TensorDictBase, rule: ReplayRule, wanted: Tensor | None = None
) -> TensorDict:
    """Levels that were scored, one after another, each in a place of its own.

    A level that is there already gets its new score. Another one gets the next free slot; where
    there is none, that of the level that is least likely to be drawn, if its score is higher than
    that one's. Equal levels among the new ones count once, with the mean of their scores.

    Args:
        buffer: [K, N].
        new: [K, M] with ``level``, ``score``, ``best`` and ``solved``, and where it is not zero
            ``parent`` and ``generation``. Scores that are not finite are those of levels not to be
            kept.
        rule: of the draws.
        wanted: bool [K], of the copies whose levels are inserted; None for all.
    """
    key = level_keys(new["level"])
    same, none = _alike(key), torch.zeros_like(key)
    told = {
        "score": _means(same, new["score"]),
        "best": new["best"].unsqueeze(-2).where(same, -torch.inf).amax(-1),
        "solved": (new["solved"].unsqueeze(-2) & same).any(-1),
        "key": key,
        "parent": new.get("parent", none),
        "generation": new.get("generation", none),
        "draws": none,
    }
    buffer = buffer.clone()
    for copy in range(len(key)) if wanted is None else wanted.nonzero().flatten().tolist():
        numbers = {name: entry[copy] for name, entry in buffer.items() if name != "level"}
        source = torch.full_like(numbers["key"], -1)  # which new level lies in each slot
        for i, values in enumerate(zip(*(entry[copy] for entry in told.values()), strict=True)):
            _insert_one(numbers, source, i, dict(zip(told, values, strict=True)), rule)
        slots = (source >= 0).nonzero().flatten()
        buffer["level"][copy, slots] = new["level"][copy, source[slots]].cpu()
    return buffer


def rescore(
    buffer: TensorDictBase, slots: Tensor, score: Tensor, best: Tensor, solved: Tensor
) -> TensorDict:
    """New scores of levels that were drawn.

    Args:
        buffer: [K, N].
        slots: int64 [K, P]; of a slot that occurs several times the mean score counts.
        score: float [K, P]; one that is not finite leaves the level's old score.
        best: float [K, P], the highest returns, of which the highest ever is kept.
        solved: bool [K, P], whether there was a success, of which one is enough for ever.
    """
    finite = score.double().where(score.isfinite(), 0.0)
    none = torch.zeros_like(buffer["score"])
    counts = none.scatter_add(1, slots, score.isfinite().to(none))
    means = none.scatter_add(1, slots, finite.to(none)) / counts
    scores = means.where(counts > 0, buffer["score"])
    seen = {
        name: buffer[name].scatter_reduce(1, slots, new.to(buffer[name]), "amax")
        for name, new in zip(SEEN, (best, solved), strict=True)
    }
    return _changed(buffer, score=scores, **seen)


def level_keys(levels: Any) -> Tensor:
    """A number for each level, equal for equal levels and else different: int64 [*B].

    Hashes of the bytes of all entries: two levels collide with a probability of 2^-64.
    """
    entries = (levels.get(name).cpu() for name in sorted(levels.keys(True, True), key=str))
    rows = [entry.reshape(levels.batch_size.numel(), -1).numpy() for entry in entries]
    keys = [
        int.from_bytes(
            blake2b(b"".join(row[i].tobytes() for row in rows), digest_size=8).digest(),
            "little",
            signed=True,
        )
        for i in range(levels.batch_size.numel())
    ]
    return torch.tensor(keys, dtype=torch.int64).reshape(levels.batch_size)


def _insert_one(
    numbers: dict[str, Tensor], source: Tensor, i: int, new: dict[str, Tensor], rule: ReplayRule
) -> None:
    """Insert the i-th new level among those of one copy, [N] each, in place."""
    clock, filled, score = numbers["clock"], numbers["filled"], numbers["score"]
    clock += 1
    if not bool(new["score"].isfinite()):
        return
    same = filled & (numbers["key"] == new["key"])
    if bool(same.any()):
        slot = int(same.nonzero()[0])
        score[slot] = new["score"]
        for name in SEEN:
            numbers[name][slot] = torch.maximum(numbers[name][slot], new[name])
    else:
        free = (~filled).nonzero()
        if len(free):
            slot = int(free[0])
        else:
            slot = int(replay_weights(score, clock - numbers["touched"], filled, rule).argmin())
            if not bool(new["score"] > score[slot]):
                return
        filled[slot] = True
        source[slot] = i
        for name, value in new.items():
            numbers[name][slot] = value
    numbers["touched"][slot] = clock[slot]


def _alike(group: Tensor) -> Tensor:
    """Which entries have the same number [K, M]: bool [K, M, M]."""
    return group.unsqueeze(-1) == group.unsqueeze(-2)


def _means(same: Tensor, score: Tensor) -> Tensor:
    """Means of the finite scores [K, M] over what is the same, bool [K, M, M]; else nan."""
    counts = same & score.isfinite().unsqueeze(-2)
    return score.double().unsqueeze(-2).where(counts, torch.nan).nanmean(-1)


def _shares(weight: Tensor) -> Tensor:
    return weight / weight.sum(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)


def _changed(buffer: TensorDictBase, **entries: Tensor) -> TensorDict:
    changed = buffer.copy()
    for name, entry in entries.items():
        changed.set(name, entry)
    return changed
