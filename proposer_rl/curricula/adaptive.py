"""A mixture of uniform sampling, the target, and a way from what is mastered to the target."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from scipy.optimize import linear_sum_assignment
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.belief import Belief
from proposer_rl.curricula.contract import Batch, Curriculum, Inbox
from proposer_rl.curricula.student import Student
from proposer_rl.settings import Count, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Space

TARGET, UNIFORM, WAY = range(3)
ARMS = ("target", "uniform", "way")


class AdaptiveMixture(Curriculum):
    remembers = ()

    @checked
    def __init__(
        self,
        space: Space,
        target: Distribution | None = None,
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
        step: float = 1.0,
        skilled: float = 0.5,
        least_skill: float = 0.2,
    ) -> None:
        self.reads = ("success",)
        self._space, self._target = space, target
        self._half_life, self._delta, self._floor = half_life, delta, floor
        self._times, self._learn = times, learn
        self._low, self._high, self._half = low, high, half
        self._memory, self._remember = memory, remember
        self._given = shares
        self._step, self._skilled, self._least_skill = step, skilled, least_skill
        self._inbox = Inbox()
        self._belief: Belief | None = None
        self._sums: Tensor | None = None  # [K, 3, 5]
        self._best: Tensor | None = None  # [K]
        self._log: dict[str, Any] = {}
        self._place: dict[int, Tensor] = {}  # particles [m, D]

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        students = len(streams)
        if self._belief is None:
            self._begin(students)
        self._take_in()
        shares = self._shares()
        self._log["shares"] = [dict(zip(ARMS, one.tolist(), strict=True)) for one in shares]
        batches, arms = zip(
            *(self._batch(k, count, shares[k], s) for k, s in enumerate(streams)), strict=True
        )
        levels, arms = torch.stack(batches), torch.stack(arms)
        inputs = self._inputs(levels)
        predicted = self._belief.predict(inputs, self._items(levels))
        return self._inbox.batch(levels, arm=arms, inputs=inputs, predicted=predicted)

    def _begin(self, students: int) -> None:
        width = self._inputs(self._space.sample(1, torch.Generator())).shape[-1]
        self._belief = Belief(students, width, None, half_life=self._half_life)
        self._sums = torch.zeros(students, 3, 5, dtype=torch.float64)
        self._best = torch.zeros(students, dtype=torch.float64)

    def _batch(self, k: int, count: int, shares: Tensor, streams: Streams) -> tuple[Any, Tensor]:
        """Levels [n] of one student, and their arms."""
        draw = streams.generator("levels")
        arms = allot(shares, count, draw)
        of = torch.bincount(arms, minlength=3).tolist()
        parts = []
        if of[TARGET]:
            parts.append(self._target.sample(of[TARGET], draw))
        if of[UNIFORM]:
            parts.append(self._space.sample(of[UNIFORM], draw))
        if of[WAY]:
            parts.append(self._way(k, of[WAY], draw))
        order = torch.randperm(count, generator=draw)
        return torch.cat(parts)[order], arms[order]

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        self._inbox.check(batch, outcome)
        items = self._items(batch.levels)
        extra = {} if items is None else {"items": items}
        self._inbox.put(
            batch,
            arm=batch.notes["arm"],
            inputs=batch.notes["inputs"],
            predicted=batch.notes["predicted"],
            returns=outcome["return"].double(),
            success=outcome["success"].double(),
            **extra,
        )

    def log(self) -> dict[str, Any]:
        self._take_in()
        out, self._log = self._log, {}
        return out

    def _inputs(self, levels: Any) -> Tensor:
        space: Any = self._space
        return space.locate(levels).double().cpu()

    def _items(self, levels: Any) -> Tensor | None:
        return None

    def _take_in(self) -> None:
        for evidence in self._inbox.take():
            self._belief.grow_older()
            self._belief.observe(
                evidence["inputs"], evidence["success"], evidence.get("items", None)
            )
            error = (evidence["predicted"] - evidence["success"]).square()
            constant = evidence["success"].var(1, correction=0)
            self._log["brier"] = error.mean(1).tolist()
            self._log["brier_constant"] = constant.tolist()
            of = torch.nn.functional.one_hot(evidence["arm"], 3).double().mT  # [K, 3, n]
            r = evidence["returns"]
            stats = torch.stack([torch.ones_like(r), evidence["success"], error, r, r.square()], -1)
            self._sums = 0.5 ** (1 / self._memory) * self._sums + of @ stats
            tried, won = self._sums[:, TARGET, 0], self._sums[:, TARGET, 1]
            self._best = torch.maximum(self._best * 0.5 ** (1 / self._remember), won / (tried + 4))

    def _shares(self) -> Tensor:
        """Shares by what is seen: of the target by its success, of the way by the belief's skill."""
        if self._given is not None:
            return torch.tensor([self._given] * len(self._best), dtype=torch.float64)
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
        self._log["skill"], self._log["signal"] = skill.tolist(), signal.tolist()
        self._log["target_success"] = self._best.tolist()
        return torch.stack([target, (1 - target) * (1 - part), (1 - target) * part], -1)

    def _way(self, k: int, count: int, draw: torch.Generator) -> Any:
        space: Any = self._space
        goals = self._inputs(self._target.sample(count, draw))
        many = self._times * count
        fresh = space.sample(many // 2, draw)
        if hasattr(space, "at"):
            start = self._place.get(k)
            start = self._inputs(fresh) if start is None else start
            rest = many - many // 2
            a = start[torch.randint(len(start), (rest,), generator=draw)]
            b = goals[torch.randint(count, (rest,), generator=draw)]
            far = self._step * torch.rand(rest, 1, generator=draw, dtype=torch.float64)
            noise = torch.randn(rest, a.shape[1], generator=draw, dtype=torch.float64)
            points = (a + far * (b - a) + 0.05 * noise).clamp(-1, 1)
            fresh = torch.cat([fresh, space.at(points[None], [draw])[0]])
        places = self._inputs(fresh)
        p = self._belief.predict(places, self._items(fresh), k)
        allowed = p >= p.max().clamp(max=self._delta)
        size = goals.square().sum(-1, keepdim=True) + places.square().sum(-1)
        cost = (size - 2 * goals @ places.mT) / max(goals.shape[1], 1)
        cost = cost + torch.where(allowed, 0.0, 1e3) - self._learn * 4 * (p * (1 - p))
        _, columns = linear_sum_assignment(cost.numpy())
        self._place[k] = places[columns]
        return fresh[torch.from_numpy(columns)]


def allot(shares: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Arms of a batch, int64 [n], whose numbers are as the shares on average."""
    edges = shares.cumsum(0) * count
    start = torch.rand(1, generator=generator, dtype=torch.float64)
    ticks = start + torch.arange(count)
    return torch.searchsorted(edges, ticks).clamp(max=len(shares) - 1)
