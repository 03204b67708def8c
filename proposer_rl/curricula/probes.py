"""How good students are in each bin: what they reach on fixed levels of it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from proposer_rl.curricula.student import Student
from proposer_rl.streams import Streams
from proposer_rl.task import NoSuccessError, Space

Measure = Literal["success", "return"]
MANY = 10_000  # levels of a scoring pass, beyond which its cost is told


def tell_cost(space: Space, each: int, name: str) -> None:
    """Warn of many levels in a scoring pass, where each bin has so many of what has this name."""
    if space.size * each > MANY:
        warnings.warn(
            f"{space.size:,} bins with {each} {name} each: {space.size * each:,} levels are "
            f"evaluated at every scoring pass; fewer bins, or a lower `{name}`, cost less",
            stacklevel=2,
        )


class Probes:
    """Fixed levels of every bin, each student's own, on which its performance is measured.

    The levels are drawn at the first time, from the streams of that proposal, and stay. What is
    measured is exact where the student's performance is; otherwise all students of a population
    draw from the streams of the first, so that then one of several does not do what it would do
    alone.

    Args:
        space: that has the bins.
        count: levels of each bin.
        measure: ``"success"`` or ``"return"``.
    """

    def __init__(self, space: Space, count: int, measure: Measure) -> None:
        self._space, self._count, self.measure = space, count, measure
        tell_cost(space, count, "probes")
        self._drawn_from: list[list[Any]] = []
        self._levels: Any = None

    def performance(self, student: Student, streams: Sequence[Streams]) -> Tensor:
        """Mean performance of K students in each bin: float32 [K, N], on the CPU.

        Args:
            student: that is measured.
            streams: of the proposal.

        Raises:
            NoSuccessError: if success is to be measured and the task tells none.
        """
        size = self._space.size
        if self._levels is None:
            self._drawn_from = self._drawn_from or [s.address for s in streams]
            bins = torch.arange(size).repeat_interleave(self._count)
            own = [Streams(*address).generator("probes") for address in self._drawn_from]
            self._levels = self._space.generate(bins.expand(len(own), -1), own)
        draws = streams[0].generator("probe_episodes")
        performance = student.performance(self._levels, draws)
        if self.measure not in performance.keys():
            raise NoSuccessError(
                f"measure={self.measure}: this task tells no success, only the return; give "
                "measure=return"
            )
        reached = performance[self.measure].unflatten(-1, (size, self._count)).mean(-1)  # [K, N]
        return reached.float().cpu()

    def state_dict(self) -> dict[str, Any]:
        """Which streams the levels were drawn from, so that they can be drawn again."""
        return {"drawn_from": [list(address) for address in self._drawn_from]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the levels of a state."""
        self._levels = None
        self._drawn_from = [list(address) for address in state["drawn_from"]]
