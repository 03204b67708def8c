"""First-order gain: trains on the bins that raise performance on the target fastest."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from proposer_rl.curricula.batches import levels_in
from proposer_rl.curricula.bins import BinCurriculum, along_axes
from proposer_rl.curricula.student import Student
from proposer_rl.meta.assembly import Components
from proposer_rl.meta.first_order import TargetMeasure, bin_scores
from proposer_rl.settings import Count, Decay, Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Space


class FirstOrderCurriculum(BinCurriculum):
    """Draws bins by the mean alignment of fresh levels in each, which nobody plays.

    The alignment of a level is the slope of its return along the direction of the parameters that
    raises the target's performance fastest (:mod:`proposer_rl.meta.first_order`). Returns are
    exact: no frames are spent.

    Args:
        space: that has the bins.
        target: the distribution to master.
        every: number of batches between two scoring passes.
        temperature: the share of bin n is proportional to exp(s_n / (temperature * max |s|)), with
            s its averaged score.
        smoothing: share of the old score in the average.
        target_levels: number E of fresh levels of the target that give the direction.
        candidates: number C of levels of each bin.
        step: of the finite differences that give the alignments, in learning rates.
        measure: of the target's performance; see
            :func:`~proposer_rl.meta.first_order.target_performance`.
    """

    needs = ("target_direction", "alignment")

    @checked
    def __init__(
        self,
        space: Space,
        target: Distribution,
        *,
        every: Count = 2,
        target_levels: Count = 128,
        candidates: Count = 8,
        step: Positive = 1.0,
        temperature: Positive = 0.1,
        smoothing: Decay = 0.9,
        measure: TargetMeasure = "log_success",
    ) -> None:
        super().__init__(space, every=every)
        self._temperature, self.smoothing = temperature, smoothing
        self._target, self._target_levels = target, target_levels
        self._candidates, self._step, self._measure = candidates, step, measure

    @classmethod
    def create(cls, run: Components, **settings: Any) -> FirstOrderCurriculum:
        """Makes it for a run's space and target."""
        return cls(run.task.space, run.task.target, **settings)

    def score(self, student: Student, count: int, rng: Streams) -> None:
        """Scores every bin by fresh levels, and averages the scores over time."""
        size, each = self.space.size, self._candidates
        target = self._target.sample(self._target_levels, rng.generator("target"))
        reached, direction = student.target_direction(target, self._measure)
        bins = torch.arange(size).repeat_interleave(each)
        levels = levels_in(self.space, bins, rng.generator("candidates"))
        aligned = student.alignment(direction, levels, self._step)
        score, error = (x.cpu() for x in bin_scores(aligned.unflatten(-1, (size, each))))
        old = self.smoothing if self.scores else 0.0
        before = self.scores or {"score": score, "variance": error.square()}
        self.scores = {
            "score": old * before["score"] + (1 - old) * score,
            "variance": old**2 * before["variance"] + (1 - old) ** 2 * error.square(),
            "target": reached.cpu(),
        }

    def shares(self) -> Tensor:
        """Returns the shares of the bins in the next batch, float [N]."""
        score = self.scores["score"]
        largest = score.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(score.dtype).tiny)
        return (score / (self._temperature * largest)).softmax(-1)

    def log(self) -> dict[str, Any]:
        """Adds the last performance on the target and the standard errors of the scores."""
        record = super().log()
        if record:
            record["target_performance"] = float(self.scores["target"])
        if record and self._candidates > 1:
            record["score_error"] = along_axes(self.scores["variance"].sqrt(), self.space)
        return record
