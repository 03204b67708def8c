"""Independent draws from a fixed distribution."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from proposer_rl.curricula.base import Curriculum, Proposal
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution


class SamplingCurriculum(Curriculum):
    """Fresh levels of one distribution at every update: the target, or domain randomization.

    Args:
        distribution: to draw from.
    """

    def __init__(self, distribution: Distribution) -> None:
        self._distribution = distribution

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Draws of the distribution, each Solver's from its own streams."""
        count = learner.env.batch_size[1:].numel()
        draws = [self._distribution.sample(count, s.generator("levels")) for s in streams]
        return Proposal(torch.stack(draws))
