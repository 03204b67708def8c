"""Independent draws from a fixed distribution, or a choice among them."""

from __future__ import annotations

from collections.abc import Sequence

from proposer_rl.curricula.base import Curriculum, Proposal
from proposer_rl.curricula.batches import fresh_levels
from proposer_rl.curricula.choice import Choice
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution


class SamplingCurriculum(Curriculum):
    """Fresh levels of one distribution at every update: the target, or domain randomization.

    Args:
        distribution: to draw from.
        choice: of those that are trained on, among several times as many; None for all.
    """

    def __init__(self, distribution: Distribution, choice: Choice | None = None) -> None:
        self._distribution = distribution
        self._choice = choice

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Draws of the distribution, each Solver's from its own streams."""
        count = learner.env.batch_size[1:].numel()
        if self._choice is None:
            return Proposal(fresh_levels(self._distribution, count, streams, "levels"))
        many = fresh_levels(self._distribution, self._choice.times * count, streams, "levels")
        return self._choice(learner, Proposal(many), streams)[1]
