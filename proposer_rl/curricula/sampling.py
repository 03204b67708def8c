"""Independent draws from a fixed distribution: the target, or domain randomization."""

from __future__ import annotations

from collections.abc import Sequence

from proposer_rl.curricula.batches import fresh_levels
from proposer_rl.curricula.contract import Batch, Curriculum
from proposer_rl.curricula.student import Student
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution


class SamplingCurriculum(Curriculum):
    """Fresh levels of one distribution in every batch, whatever came of the last one.

    Args:
        distribution: to draw from.
    """

    def __init__(self, distribution: Distribution) -> None:
        self._distribution = distribution

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Draws of the distribution, each student's from its own streams."""
        levels = fresh_levels(self._distribution, count, streams, "levels")
        return Batch(levels)
