"""CurrOT on the bins: a distribution that moves to the target through what is mastered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from proposer_rl.curricula.base import Improvement
from proposer_rl.curricula.bins import BinCurriculum
from proposer_rl.curricula.checks import real
from proposer_rl.curricula.choice import Choice
from proposer_rl.curricula.probes import Probes
from proposer_rl.learning import PPO
from proposer_rl.streams import Streams
from proposer_rl.task import LocatedTarget, Task

NOTHING = 1e-6  # a share that is rounding of the solver's


class TargetTask(Task):
    """A task whose target lies in its space; see :class:`~proposer_rl.task.LocatedTarget`."""

    target_shares: Tensor


class TransportCurriculum(BinCurriculum):
    """Draws each Solver's batch from a distribution that moves towards the target.

    At a look, the distribution p over the bins becomes the nearest to the target, in the
    2-Wasserstein distance of the space's coordinates, among those that are within epsilon of the
    present one and on bins in which the Solver's performance is at least delta (Klink et al. 2022,
    "Curriculum Reinforcement Learning via Constrained Optimal Transport", ICML). Where no bin is,
    those of the best performance are taken for it, so that the search begins with what is easiest.
    A Solver's first distribution is even.

    See :func:`~proposer_rl.curricula.transport.step_towards` for the program, and for what happens
    when the Solver forgets.

    Args:
        task: that knows where its target lies.
        delta: least performance of a bin that is drawn from.
        epsilon: how far the distribution moves at a look; neighbouring bins of an axis with n
            values are about 2 / (n - 1) apart.
        every: updates between two looks at the Solvers.
        probes: levels of each bin.
        measure: of performance, ``"success"`` or ``"return"``.
        choice: see :class:`BinCurriculum`.

    Raises:
        TypeError: if the task does not say where its target lies.
        ValueError: if a value is out of range.
    """

    told = ("performance",)

    def __init__(
        self,
        task: Task,
        *,
        delta: float = 0.3,
        epsilon: float = 0.3,
        every: int = 5,
        probes: int = 16,
        measure: str = "success",
        choice: Choice | None = None,
    ) -> None:
        located = require_target(task)
        self._delta = real("delta", delta)
        self._epsilon = real("epsilon", epsilon, above=0)
        self._probes = Probes(task, probes, measure)
        target = located.target_shares.double()
        self._target = (target / target.sum()).numpy()
        places = task.space.coordinates.double()
        self._costs = torch.cdist(places, places, compute_mode="donot_use_mm_for_euclid_dist")
        self._costs = self._costs.square()
        super().__init__(task, every=every, choice=choice)

    def begin(self) -> None:
        """Forget the last Solver: its distribution and its probes."""
        super().begin()
        self._probes.forget()

    def look(self, learner: PPO, streams: Sequence[Streams]) -> tuple[int, int]:
        """Move the distributions, each by its own Solver's performance on the probes."""
        from proposer_rl.curricula.transport import step_towards  # SciPy's solvers: no other needs

        performance, evaluations = self._probes.performance(learner, streams)
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
        return 0, evaluations

    def shares(self) -> Tensor:
        """Of the bins in the next batch, float [K, N]."""
        return self.scores["share"]

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """... and how many bins are allowed, and how far off the target is, in W2."""
        told = super().improve(learner, updates, streams)
        if told.metrics:
            told.metrics["allowed_bins"] = self.scores["allowed"].sum(-1).tolist()
            told.metrics["target_distance"] = self.scores["distance"].squeeze(-1).tolist()
        return told

    def state_dict(self) -> dict[str, Any]:
        """The probes too."""
        return {**super().state_dict(), "probes": self._probes.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        super().load_state_dict(state)
        self._probes.load_state_dict(state["probes"])


def require_target(task: Task) -> TargetTask:
    """The task, if it says where its target lies; else a TypeError."""
    if not isinstance(task, LocatedTarget):
        raise TypeError(
            f"currot moves towards the target: {type(task).__name__} must define target_shares, "
            "the target as shares of the space's bins"
        )
    located: Any = task
    return located
