"""CurrOT on the bins: a distribution that moves to the target through what is mastered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from proposer_rl.curricula.bins import BinCurriculum
from proposer_rl.curricula.checks import real
from proposer_rl.curricula.probes import Probes
from proposer_rl.curricula.student import Student
from proposer_rl.streams import Streams
from proposer_rl.task import Space

NOTHING = 1e-6  # a share that is rounding of the solver's


class TransportCurriculum(BinCurriculum):
    """Draws each student's batch from a distribution that moves towards the target.

    At a scoring pass, the distribution p over the bins becomes the nearest to the target, in the
    2-Wasserstein distance of the space's coordinates, among those that are within epsilon of the
    present one and on bins in which the student's performance is at least delta (Klink et al. 2022,
    "Curriculum Reinforcement Learning via Constrained Optimal Transport", ICML). Where no bin is,
    those of the best performance are taken for it, so that the search begins with what is easiest.
    A student's first distribution is uniform.

    See :func:`~proposer_rl.curricula.transport.step_towards` for the program, and for what happens
    when the student forgets.

    Args:
        space: that has the bins.
        target_shares: the target as shares of the bins, float [N].
        delta: least performance of a bin that is drawn from.
        epsilon: how far the distribution moves at a scoring pass; neighbouring bins of an axis with
            n values are about 2 / (n - 1) apart.
        every: batches between two scoring passes.
        probes: levels of each bin.
        measure: of performance, ``"success"`` or ``"return"``.

    Raises:
        ValueError: if a value is out of range, or there is not one share for each bin.
    """

    shown = ("performance",)

    def __init__(
        self,
        space: Space,
        target_shares: Tensor,
        *,
        delta: float = 0.3,
        epsilon: float = 0.3,
        every: int = 5,
        probes: int = 16,
        measure: str = "success",
    ) -> None:
        super().__init__(space, every=every)
        if target_shares.shape != (space.size,):
            raise ValueError(
                f"target_shares must be one for each of {space.size} bins, got shape "
                f"{list(target_shares.shape)}"
            )
        self._delta = real("delta", delta)
        self._epsilon = real("epsilon", epsilon, above=0)
        self._probes = Probes(space, probes, measure)
        target = target_shares.double()
        self._target = (target / target.sum()).numpy()
        places = space.coordinates.double()
        self._costs = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
        self._costs = self._costs.square()

    @property
    def needs(self) -> tuple[str, ...]:
        """The performance on its probes."""
        return ("performance",)

    def score(self, student: Student, count: int, streams: Sequence[Streams]) -> None:
        """Move the distributions, each by its own student's performance on the probes."""
        from proposer_rl.curricula.transport import step_towards  # SciPy's solvers: no other needs

        performance = self._probes.performance(student, streams)
        best = performance.amax(-1, keepdim=True)
        allowed = performance >= best.clamp(max=self._delta)
        even = torch.full(performance.shape, 1 / performance.shape[-1], dtype=torch.float64)
        steps = [
            step_towards(self._target, now, self._costs.numpy(), mask, self._epsilon)
            for now, mask in zip(
                self.scores.get("share", even).numpy(), allowed.numpy(), strict=True
            )
        ]
        shares, left = zip(*steps, strict=True)
        share = torch.from_numpy(np.stack(shares))
        share = share.where(share > NOTHING, 0.0)
        self.scores = {
            "share": share / share.sum(-1, keepdim=True),
            "performance": performance,
            "allowed": allowed,
            "distance": torch.tensor(left).clamp(min=0).sqrt().unsqueeze(-1),
        }

    def shares(self) -> Tensor:
        """Of the bins in the next batch, float [K, N]."""
        return self.scores["share"]

    def log(self) -> dict[str, Any]:
        """Besides, how many bins are allowed, and how far off the target is, in W2."""
        told = super().log()
        if told:
            told["allowed_bins"] = self.scores["allowed"].sum(-1).tolist()
            told["target_distance"] = self.scores["distance"].squeeze(-1).tolist()
        return told

    def state_dict(self) -> dict[str, Any]:
        """The probes too."""
        return {**super().state_dict(), "probes": self._probes.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        super().load_state_dict(state)
        self._probes.load_state_dict(state["probes"])
