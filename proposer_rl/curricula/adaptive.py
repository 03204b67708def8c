"""A mixture of the target, uniform sampling and a way between them, whose shares follow what is seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from proposer_rl.curricula.batches import packed
from proposer_rl.curricula.belief import Belief
from proposer_rl.curricula.contract import Batch, Curriculum, Inbox
from proposer_rl.curricula.student import Student
from proposer_rl.settings import Count, Positive, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels, Space, level_inputs

Inputs = Callable[[Levels], Tensor]
"""What is known of levels [*B]: float [*B, D], each -1 to 1."""
ARMS = ("target", "uniform", "way")
TARGET, UNIFORM, WAY = range(3)
STATISTICS = ("levels", "labels", "errors", "returns", "squares")  # sums, of each arm
NEAR = 0.025  # standard deviation of what is added on the way, in shares of a range
AT_ONCE = 64  # levels of the way that are assigned to goals together
FORBIDDEN = 1e3  # cost of a candidate that is not mastered
PRIOR = 4.0  # failures on the target that are taken for seen


class AdaptiveMixture(Curriculum):
    remembers = ("_inbox", "_sums", "_best")

    @checked
    def __init__(
        self,
        space: Space,
        target: Distribution | None = None,
        inputs: Inputs | None = None,
        *,
        half_life: float = 12.0,
        delta: float = 0.3,
        floor: Share = 0.1,
        times: Count = 4,
        learn: float = 0.2,
        low: float = 0.25,
        high: float = 0.9,
        half: float = 0.1,
        memory: float = 6.0,
        remember: float = 20.0,
        shares: list[float] | None = None,
        skilled: float = 0.5,
        least_skill: float = 0.2,
    ) -> None:
        self._space, self._target = space, target
        self._known = inputs or partial(level_inputs, space)
        self._half_life, self._delta, self._floor = half_life, delta, floor
        self._times, self._learn = times, learn
        self._low, self._high, self._half = low, high, half
        self._memory, self._remember = memory, remember
        self._given = shares
        self._skilled, self._least_skill = skilled, least_skill
        self._inbox = Inbox()
        self._belief: Belief | None = None
        self._sums = torch.zeros(0, len(ARMS), len(STATISTICS), dtype=torch.float64)
        self._best = torch.zeros(0, dtype=torch.float64)  # success seen on the target
        self._last: dict[str, Levels] = {}  # on the way, of each student [m]
        self._logged: dict[str, Any] = {}

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        self._begin(len(streams))
        self._take_in()
        shares = self._shares()
        made = [self._batch(k, count, shares[k], own) for k, own in enumerate(streams)]
        levels, arms = (torch.stack(one) for one in zip(*made, strict=True))
        inputs, items = self._inputs(levels), self._items(levels)
        notes = {} if items is None else {"items": items}
        predicted = self._belief.predict(inputs, items)
        return self._inbox.batch(levels, arm=arms, inputs=inputs, predicted=predicted, **notes)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        self._inbox.check(batch, outcome)
        notes = batch.notes.exclude("number", "place", "size")
        results = {name: outcome[name].double().cpu() for name in ("return", "success") if name in outcome.keys()}
        self._inbox.put(batch, **notes, **results)

    def log(self) -> dict[str, Any]:
        self._take_in()
        logged, self._logged = self._logged, {}
        return logged

    def state_dict(self) -> dict[str, Any]:
        belief = {} if self._belief is None else self._belief.state_dict()
        return {**super().state_dict(), "belief": belief, "last": {k: packed(levels) for k, levels in self._last.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if state["belief"]:
            self._begin(len(state["best"]))
            self._belief.load_state_dict(state["belief"])
        super().load_state_dict(state)
        like = type(self._space.sample(1, torch.Generator()))
        self._last = {k: like.from_dict(one, batch_dims=1) for k, one in state["last"].items()}

    def _begin(self, students: int) -> None:
        if self._belief is None:
            one = self._space.sample(1, torch.Generator())
            items = 0 if self._items(one) is None else self._space.size
            self._belief = Belief(
                students, self._inputs(one).shape[-1], items, half_life=self._half_life
            )
            self._sums = self._sums.new_zeros(students, *self._sums.shape[1:])
            self._best = self._best.new_zeros(students)

    def _take_in(self) -> None:
        for seen in self._inbox.take():
            label = seen["success"]
            self._belief.grow_older()
            self._belief.observe(seen["inputs"], label, seen.get("items", None))
            error = (seen["predicted"] - label).square()
            self._logged["brier"] = error.mean(1).tolist()
            self._logged["brier_constant"] = label.var(1, correction=0).tolist()
            returns = seen["return"]
            rows = torch.stack(
                [torch.ones_like(label), label, error, returns, returns.square()], -1
            )
            of = F.one_hot(seen["arm"], len(ARMS)).double().mT
            self._sums = 0.5 ** (1 / self._memory) * self._sums + of @ rows
            tried, won = self._sums[:, TARGET, :2].unbind(-1)
            best = self._best * 0.5 ** (1 / self._remember)
            self._best = torch.maximum(best, won / (tried + PRIOR))

    def _shares(self) -> Tensor:
        """Shares by what is seen: of the target by its success, of the way by the belief's skill."""
        if self._given is not None:
            shares = torch.tensor([self._given] * len(self._best), dtype=torch.float64)
        else:
            number, won, error, r, rr = self._sums.unbind(-1)
            every = self._sums.sum(1)
            spread = (every[:, 4] / every[:, 0] - (every[:, 3] / every[:, 0]).square()).clamp(min=0)
            mean = r / number
            own = (rr / number - mean.square()).clamp(min=0)[:, TARGET]
            signal = (own / spread.clamp(min=1e-12)).sqrt().nan_to_num(1.0).clamp(max=1)
            rate = won[:, UNIFORM] / number[:, UNIFORM].clamp(min=1e-9)
            base = number[:, UNIFORM] * rate * (1 - rate)
            skill = 1 - (error[:, UNIFORM] + 1) / (base + 1)
            low = self._floor + (self._low - self._floor) * (2 * signal).clamp(max=1)
            target = low + (self._high - low) * self._best / (self._best + self._half)
            part = (self._skilled + 0.5 * (skill - 0.2)).clamp(self._least_skill, 0.8)
            self._logged["skill"], self._logged["signal"] = skill.tolist(), signal.tolist()
            self._logged["target_success"] = self._best.tolist()
            shares = torch.stack([target, (1 - target) * (1 - part), (1 - target) * part], -1)
        self._logged["shares"] = [dict(zip(ARMS, one.tolist(), strict=True)) for one in shares]
        return shares

    def _batch(
        self, k: int, count: int, shares: Tensor, streams: Streams
    ) -> tuple[Levels, Tensor]:
        """Returns levels [n] of one student in a random order, and their arms."""
        draw = streams.generator("levels")
        arms = allotted(shares, count, draw)
        target, uniform, way = torch.bincount(arms, minlength=len(ARMS)).tolist()
        parts = [self._target.sample(target, draw), self._space.sample(uniform, draw)]
        if way:
            parts.append(self._way(k, way, draw))
        order = torch.randperm(count, generator=draw)
        return torch.cat(parts)[order], arms[order]

    def _way(self, k: int, count: int, draw: torch.Generator) -> Levels:
        """Returns levels [n] that are mastered, and near to the target."""
        targets = self._target.sample(count, draw)
        levels = self._candidates(k, self._times * count, targets, draw)
        goals, x, items = self._inputs(targets), self._inputs(levels), self._items(levels)
        p = self._belief.predict(x[None], None if items is None else items[None], slice(k, k + 1))[0]
        bonus = self._learn * 4 * p * (1 - p)
        extra = torch.where(p >= p.max().clamp(max=self._delta), -bonus, FORBIDDEN)
        chosen = []
        for start in range(0, count, AT_ONCE):
            some = slice(start, start + AT_ONCE)
            few = torch.arange(start * self._times, min(start + AT_ONCE, count) * self._times)
            far = torch.cdist(goals[some], x[few]).square() / max(x.shape[1], 1)
            chosen.append(few[assigned(far + extra[few])])
        self._last[str(k)] = levels[torch.cat(chosen)]
        return self._last[str(k)]

    def _candidates(
        self, k: int, count: int, targets: Levels, draw: torch.Generator
    ) -> Levels:
        """Returns levels [n] of the whole space and, where there is a between, from there to goals."""
        space: Any = self._space
        if not hasattr(space, "between"):
            return space.sample(count, draw)
        half = count // 2
        fresh = space.sample(count - half, draw)
        last = self._last.get(str(k), fresh)
        a = last[torch.randint(len(last), (half,), generator=draw)]
        b = targets[torch.randint(len(targets), (half,), generator=draw)]
        every = torch.cat([fresh, space.between(a, b, NEAR, draw)])
        return every[torch.randperm(count, generator=draw)]

    def _inputs(self, levels: Levels) -> Tensor:
        return self._known(levels).double().cpu()

    def _items(self, levels: Levels) -> Tensor | None:
        return self._space.items(levels) if hasattr(self._space, "items") else None


def assigned(costs: Tensor) -> Tensor:
    """Returns a candidate for each goal, none twice, at the least sum of costs.

    Args:
        costs: float64 [G, C], C at least G.

    Returns:
        int64 [G].
    """
    from scipy.optimize import linear_sum_assignment

    _, columns = linear_sum_assignment(costs.numpy())
    return torch.from_numpy(columns)


def allotted(shares: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Returns the arms of levels, int64 [n], in rising order: as many of each as its share is.

    What is left of a level is drawn, so that on average numbers are as the shares.
    """
    start = torch.rand(1, generator=generator, dtype=torch.float64)
    ticks = start + torch.arange(count)
    arms = torch.searchsorted(shares.cumsum(0) * count, ticks)
    return arms.clamp(max=len(shares) - 1)
