"""Automatic domain randomization (ADR): the range of each parameter widens with success."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from annotated_types import Interval
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.bins import CountingCurriculum, Measure
from proposer_rl.curricula.contract import Batch
from proposer_rl.curricula.points import Place, Points, refuse_crossed
from proposer_rl.curricula.student import Student
from proposer_rl.settings import Count, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Space

INSIDE = -1  # of a point that lies on no bound


class BoundsCurriculum(CountingCurriculum):
    """Draws levels uniformly within bounds that move outwards where the student succeeds.

    A level is a point of the box [-1, 1]^D that the space's coordinates span. Every coordinate has
    a lower and an upper bound, which start at the same point. Some of the levels lie on a bound:
    one coordinate is at a bound that is drawn uniformly, and the others are uniform within theirs.
    The results of these levels are collected for each bound. After ``episodes`` results, the bound
    moves outwards by a step if their mean is at least ``upper``, inwards if it is at most
    ``lower``, and starts to collect again (OpenAI et al. 2019, "Solving Rubik's Cube with a Robot
    Hand", arXiv 1910.07113, algorithm 1).

    Levels on a bound that has moved since their proposal do not count. The student trains on all
    levels, also on those at bounds. Bounds stay in the box and never exclude the start.

    Args:
        space: that has the bins.
        start: where the bounds begin, from -1 for the first to 1 for the last value of an axis, by
            the axis's name; 0, the middle, for other axes.
        step: by which a bound moves.
        lower: a bound moves inwards if the mean is at most this.
        upper: a bound moves outwards if the mean is at least this.
        episodes: number of results that decide a move.
        boundary: share of the levels that lie on a bound.
        measure: result of a level, ``"success"`` or ``"return"``.
        rounded: see :class:`~proposer_rl.curricula.points.Points`.

    Attributes:
        bounds: lower and upper ones, float64 [D, 2].

    Raises:
        ValueError: for an unknown axis, ``lower`` above ``upper``, or a space that has no points.
    """

    state = ("bounds", "_sums", "_played", "_counts")

    @checked
    def __init__(
        self,
        space: Space,
        *,
        start: dict[str, Place] | None = None,
        step: Annotated[float, Interval(gt=0, le=2)] = 0.1,
        lower: float = 0.2,
        upper: float = 0.5,
        episodes: Count = 20,
        boundary: Annotated[float, Interval(gt=0, le=1)] = 0.5,
        measure: Measure = "success",
        rounded: bool = True,
    ) -> None:
        refuse_crossed(lower, upper)
        super().__init__(space)
        self._points = Points(space, rounded)
        self.required_results = ("success",) if measure == "success" else ()
        self._start, self._step = self._points.at(start), step
        self._lower, self._upper = lower, upper
        self._episodes, self._boundary, self._measure = episodes, boundary, measure
        # Of the numbers of bounds that move, 2 d and 2 d + 1 are coordinate d's.
        self._movable = (2 * self._points.free.unsqueeze(-1) + torch.arange(2)).flatten()
        self.bounds = self._start.expand(2, -1).mT.clone()
        # Sum and number of the results on each bound since its last move, [2 D].
        self._sums = torch.zeros(2 * self._points.size, dtype=torch.float64)
        self._played = torch.zeros(2 * self._points.size, dtype=torch.int64)

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Draws points within the bounds or on them, and returns the levels [n] there."""
        points, which, places = self._draw(count, rng.generator("choices"))
        levels, bins = self._points.levels(points, rng)
        return Batch(levels, TensorDict({"bins": bins, "bound": which, "at": places}, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Moves the bounds by the results of the levels that lay on them."""
        super().observe(student, batch, outcome)
        on_bound = batch.notes["bound"] != INSIDE
        reached = outcome[self._measure].double().cpu()
        seen = batch.notes["bound"], batch.notes["at"], reached
        # Thousands at once: tensors would take a hundred times as long, number by number.
        columns = (column[on_bound].tolist() for column in seen)
        known = self.bounds, self._sums, self._played
        bounds, sums, played = (each.flatten().tolist() for each in known)
        for which, place, came_to in zip(*columns, strict=True):
            if place == bounds[which]:
                sums[which] += came_to
                played[which] += 1
                if played[which] == self._episodes:
                    bounds[which] = self._moved(which, place, sums[which] / self._episodes)
                    sums[which] = played[which] = 0
        for each, now in zip(known, (bounds, sums, played), strict=True):
            each.copy_(each.new_tensor(now).view_as(each))

    def log(self) -> dict[str, Any]:
        """Returns counts of levels by bin, the bounds, and their mean width."""
        if not bool(self._counts.any()):
            return {}
        widths = self.bounds.diff(dim=-1).squeeze(-1)[self._points.free]
        return {
            "histogram": self.histogram(),
            "bounds": self.bounds.tolist(),
            "width": float(widths.mean()),
        }

    def _draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Draws points [n, D], and returns which bound [n] each lies on and where that bound is."""
        bounds = self.bounds
        shares = torch.rand(count, len(bounds), generator=generator, dtype=torch.float64)
        points = bounds[:, 0].lerp(bounds[:, 1], shares)
        on_bound = torch.rand(count, generator=generator) < self._boundary
        which = self._movable[torch.randint(len(self._movable), (count,), generator=generator)]
        places = bounds.flatten()[which]
        moved = points.scatter(1, (which // 2).unsqueeze(-1), places.unsqueeze(-1))
        points = moved.where(on_bound.unsqueeze(-1), points)
        return points, which.where(on_bound, INSIDE), places

    def _moved(self, which: int, place: float, mean: float) -> float:
        """Returns the new place of a bound, given the mean result of the levels on it."""
        axis, side = divmod(which, 2)
        outwards = self._step if side else -self._step
        move = outwards if mean >= self._upper else -outwards * (mean <= self._lower)
        ends = sorted([float(self._start[axis]), 1.0 if side else -1.0])
        return min(max(place + move, ends[0]), ends[1])
