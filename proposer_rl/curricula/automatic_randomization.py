"""Automatic domain randomization: bounds of each parameter that move by what is reached on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.bins import Measure, along_axes, counts_of_bins
from proposer_rl.curricula.contract import Batch, Curriculum, Inbox
from proposer_rl.curricula.points import Place, Points, refuse_crossed
from proposer_rl.curricula.student import Student
from proposer_rl.settings import Count, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Space

INSIDE = -1  # of a point that lies on no bound


class BoundsCurriculum(Curriculum):
    """Draws each student's levels uniformly within bounds, which move outwards where it succeeds.

    A level is a point of the box [-1, 1]^D that the space's coordinates span. Each student has a
    lower and an upper bound of every coordinate, which begin at one point. A part of its levels lie
    on a bound: one of the bounds, drawn uniformly, gives a coordinate, and the others are uniform
    within theirs. What came of these levels is collected for each bound. When there are
    ``episodes`` of them, the bound moves outwards by a step if their mean is at least ``upper``,
    inwards if it is at most ``lower``, and collects anew (OpenAI et al. 2019, "Solving Rubik's Cube
    with a Robot Hand", arXiv 1910.07113, algorithm 1).

    Levels on a bound that has moved since they were proposed do not count. Students train on all
    levels, also those on bounds; bounds stay in the box, and never leave the start out.

    Args:
        space: that has the bins.
        start: where the bounds begin, from -1 for the first to 1 for the last value of an axis, by
            the axis's name; 0, the middle, for others.
        step: of a bound.
        lower: mean at most which a bound moves inwards.
        upper: mean at least which it moves outwards.
        episodes: that each move is decided by.
        boundary: part of the levels that lie on a bound.
        measure: of what levels come to, ``"success"`` or ``"return"``.
        rounded: see :class:`~proposer_rl.curricula.points.Points`.

    Attributes:
        bounds: lower and upper ones, float64 [K, D, 2].

    Raises:
        ValueError: for an unknown axis, ``lower`` above ``upper``, or a space that has no points.
    """

    state = ("bounds", "_sums", "_played", "_counts", "_inbox")

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
        self.space, self._points = space, Points(space, rounded)
        self.required_results = ("success",) if measure == "success" else ()
        self._start, self._step = self._points.at(start), step
        self._lower, self._upper = lower, upper
        self._episodes, self._boundary, self._measure = episodes, boundary, measure
        # Of the numbers of bounds that move, 2 d and 2 d + 1 are coordinate d's.
        self._movable = (2 * self._points.free.unsqueeze(-1) + torch.arange(2)).flatten()
        self._counts = torch.zeros(space.size, dtype=torch.int64)  # of levels that came back
        self._inbox = Inbox()
        self.bounds = torch.zeros(0, self._points.size, 2, dtype=torch.float64)
        # What the levels on each bound came to since it has moved, and how many, [K, 2 D].
        self._sums = torch.zeros(0, 2 * self._points.size, dtype=torch.float64)
        self._played = torch.zeros(0, 2 * self._points.size, dtype=torch.int64)

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Draws points within the bounds and on them, and returns levels [K, n] there."""
        if not len(self.bounds):
            self.bounds = self._start.expand(len(streams), 2, -1).mT.clone()
            self._sums, self._played = (
                torch.zeros(len(streams), 2 * self._points.size, dtype=known.dtype)
                for known in (self._sums, self._played)
            )
        self._take_in()
        drawn = [
            self._draw(bounds, count, s.generator("choices"))
            for bounds, s in zip(self.bounds, streams, strict=True)
        ]
        points, which, places = map(torch.stack, zip(*drawn, strict=True))
        levels, bins = self._points.levels(points, streams)
        return self._inbox.batch(levels, bins=bins, bound=which, at=places)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Keeps what levels on bounds came to, which the next proposal adds to the bounds' sums."""
        self._inbox.check(batch, outcome)
        reached = outcome[self._measure].double()
        self._counts += counts_of_bins(batch.notes["bins"], self.space)
        self._inbox.put(batch, **batch.notes.select("bound", "at"), reached=reached)

    def log(self) -> dict[str, Any]:
        """Returns counts of levels by bin, the bounds, and the mean width between them."""
        self._take_in()
        if not len(self.bounds):
            return {}
        counts, self._counts = self._counts, torch.zeros_like(self._counts)
        widths = self.bounds.diff(dim=-1).squeeze(-1)[:, self._points.free]
        return {
            "histogram": along_axes(counts, self.space),
            "bounds": self.bounds.tolist(),
            "width": widths.mean(-1).tolist(),
        }

    def _draw(
        self, bounds: Tensor, count: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draws points [n, D] for one student; the bounds [n] that they lie on, and their places.

        Args:
            bounds: of the student, [D, 2].
            count: number n.
            generator: of the CPU.
        """
        shares = torch.rand(count, len(bounds), generator=generator, dtype=torch.float64)
        points = bounds[:, 0].lerp(bounds[:, 1], shares)
        on_bound = torch.rand(count, generator=generator) < self._boundary
        which = self._movable[torch.randint(len(self._movable), (count,), generator=generator)]
        places = bounds.flatten()[which]
        moved = points.scatter(1, (which // 2).unsqueeze(-1), places.unsqueeze(-1))
        points = moved.where(on_bound.unsqueeze(-1), points)
        return points, which.where(on_bound, INSIDE), places

    def _take_in(self) -> None:
        """Moves the bounds by what has come in, in the order of the proposals."""
        for evidence in self._inbox.take():
            for k, own in enumerate(evidence.unbind(0)):
                on_bound = own["bound"] != INSIDE
                columns = (own[name][on_bound].tolist() for name in ("bound", "at", "reached"))
                # Thousands at once: tensors would take a hundred times as long, number by number.
                bounds, sums, played = (
                    known[k].flatten().tolist() for known in (self.bounds, self._sums, self._played)
                )
                for which, place, reached in zip(*columns, strict=True):
                    if place == bounds[which]:
                        sums[which] += reached
                        played[which] += 1
                        if played[which] == self._episodes:
                            bounds[which] = self._moved(which, place, sums[which] / self._episodes)
                            sums[which] = played[which] = 0
                written = (self.bounds, bounds), (self._sums, sums), (self._played, played)
                for known, now in written:
                    known[k] = known.new_tensor(now).view_as(known[k])

    def _moved(self, which: int, place: float, mean: float) -> float:
        """Returns where a bound is after levels on it came to this in the mean."""
        axis, side = divmod(which, 2)
        outwards = self._step if side else -self._step
        move = outwards if mean >= self._upper else -outwards * (mean <= self._lower)
        ends = sorted([float(self._start[axis]), 1.0 if side else -1.0])
        return min(max(place + move, ends[0]), ends[1])
