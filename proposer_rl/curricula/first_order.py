"""Curricula in closed form: train on bins that raise the target's performance to first order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import fresh_levels
from proposer_rl.curricula.bins import (
    BinCurriculum,
    Measure,
    Probes,
    along_axes,
    means_of_bins,
    warn_of_cost,
)
from proposer_rl.curricula.contract import Batch
from proposer_rl.curricula.student import Student
from proposer_rl.curricula.transport import (
    interim_target,
    mastered,
    shares_of_bins,
    squared_distances,
)
from proposer_rl.meta.first_order import TargetMeasure, bin_scores, scaled
from proposer_rl.settings import Count, Decay, Positive, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Space


class _AlignedBins(BinCurriculum):
    """Draws each student's batch from bins by a softmax over their averaged scores.

    With s_n the exponential moving average of the n-th bin's score, its share of the batch is

        q_n  proportional to  exp( s_n / (temperature * max over n of |s_n|) ).
    """

    def __init__(self, space: Space, every: int, temperature: float, smoothing: float) -> None:
        super().__init__(space, every=every)
        self._temperature, self.smoothing = temperature, smoothing

    def shares(self) -> Tensor:
        """Returns the shares of the bins in the next batch, float [K, N]."""
        score = self.scores["score"]
        largest = score.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(score.dtype).tiny)
        return (score / (self._temperature * largest)).softmax(-1)


class FirstOrderCurriculum(_AlignedBins):
    """Scores each bin with the mean alignment of fresh levels of it, which nobody plays.

    The alignment of a level is the slope of its return along the direction of the parameters that
    raises the target's performance fastest (:mod:`proposer_rl.meta.first_order`). Returns are
    exact: no frames are spent.

    Args:
        space: that has the bins.
        target: the distribution that is to be mastered.
        every: batches between two scoring passes.
        temperature: the share of bin n is proportional to exp(s_n / (temperature * max |s|)), with
            s its averaged score.
        smoothing: share of the old score in the average.
        target_levels: fresh levels E of the target that the direction is taken from.
        candidates: levels C of each bin.
        step: of the differences that give the alignments, in learning rates.
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
        super().__init__(space, every, temperature, smoothing)
        warn_of_cost(space, candidates, "candidates")
        self._target, self._target_levels = target, target_levels
        self._candidates, self._step, self._measure = candidates, step, measure

    def score(self, student: Student, count: int, streams: Sequence[Streams]) -> None:
        """Scores every bin by fresh levels, and averages the scores over time."""
        size, each = self.space.size, self._candidates
        target = fresh_levels(self._target, self._target_levels, streams, "target")
        reached, direction = student.target_direction(target, self._measure)
        bins = torch.arange(size).repeat_interleave(each).expand(len(streams), -1)
        levels = self.space.generate(bins, [s.generator("candidates") for s in streams])
        aligned = student.alignment(direction, levels, self._step)
        score, error = (x.cpu() for x in bin_scores(aligned.unflatten(-1, (size, each))))
        old = self.smoothing if self.scores else 0.0
        before = self.scores or {"score": score, "variance": error.square()}
        self.scores = {
            "score": old * before["score"] + (1 - old) * score,
            "variance": old**2 * before["variance"] + (1 - old) ** 2 * error.square(),
            "target": reached.cpu(),
        }

    def log(self) -> dict[str, Any]:
        """Returns also the target's performance when last scored, and the scores' errors."""
        record = super().log()
        if record:
            record["target_performance"] = self.scores["target"].tolist()
        if record and self._candidates > 1:
            record["score_error"] = along_axes(self.scores["variance"].sqrt(), self.space)
        return record


class SampledFirstOrderCurriculum(_AlignedBins):
    """Scores each bin with the mean alignment of the student's own training episodes on it.

    It needs no exact returns, and so works with any environment. Where the target is never solved,
    episodes on it show no direction. An interim target takes its place: the nearest distribution on
    bins that are mastered, in which the student's performance is at least delta
    (:func:`~proposer_rl.curricula.transport.interim_target`). The direction is the policy gradient
    of the episodes that the student was trained on, each weighted by the interim target's share of
    its bin, averaged as the scores are. The score of a bin is the mean alignment of the training
    episodes on it with the direction before them. No episode is played for either, so that a part
    of each batch goes to all bins alike. Where training standardises the advantages of a batch, so
    do the scores, over what comes in of it between two proposals.

    Args:
        space: that has the bins.
        target_shares: the target as shares of the bins, float [N].
        every: batches between two scoring passes.
        delta: least performance of a bin that the interim target lies on.
        probes: levels of each bin on which performance is measured.
        measure: of performance, ``"success"`` or ``"return"``.
        temperature: the share of bin n is proportional to exp(s_n / (temperature * max |s|)), with
            s its averaged score.
        smoothing: share of the old in the averages.
        exploration: part of each batch that is drawn uniformly.

    Raises:
        ArgumentError: if there is not one share for each bin.
    """

    shown = ("score", "performance", "interim")
    needs = ("performance", "sampled_direction", "sampled_alignment")
    reads = ("rollout",)
    remembers = (*BinCurriculum.remembers, "_direction", "_gradient", "_probes")

    @checked
    def __init__(
        self,
        space: Space,
        target_shares: Tensor,
        *,
        every: Count = 1,
        delta: float = 0.2,
        probes: Count = 4,
        measure: Measure = "success",
        temperature: Positive = 0.1,
        smoothing: Decay = 0.9,
        exploration: Share = 0.2,
    ) -> None:
        super().__init__(space, every, temperature, smoothing)
        self._target, self._costs = shares_of_bins(target_shares, space), squared_distances(space)
        self._delta, self._exploration = delta, exploration
        self._probes = Probes(space, probes, measure)
        self._direction: dict[str, Tensor] = {}
        self._gradient: dict[str, Tensor] = {}  # of what came in since the last scoring pass

    def score(self, student: Student, count: int, streams: Sequence[Streams]) -> None:
        """Moves the interim target, and the direction by the gradient of what came in."""
        performance = self._probes.performance(student, streams)
        allowed = mastered(performance, self._delta)
        nothing = torch.zeros_like(performance)
        self.scores = {
            "score": self.scores.get("score", nothing),
            "performance": performance,
            "interim": interim_target(self._target, self._costs, allowed).to(performance),
        }
        if self._gradient:
            new, self._gradient = scaled(self._gradient), {}
            kept = self.smoothing if self._direction else 0.0
            before = self._direction or new
            self._direction = {k: kept * before[k].to(v) + (1 - kept) * v for k, v in new.items()}

    def evidence(
        self, student: Student, batch: Batch, outcome: TensorDictBase
    ) -> dict[str, Tensor]:
        """Returns the alignments of a batch with the present direction, after the student's update.

        Args:
            student: after it has trained on the batch.
            batch: as it was proposed, or a part of it.
            outcome: of the batch, with a ``rollout`` [K, n, T].

        Returns:
            What :func:`alignments` reads, each [K, n]; nothing before there is a direction.

        Raises:
            ValueError: if the outcome has no rollout.
        """
        if "rollout" not in outcome.keys():
            raise ValueError("alignment: the outcome has no rollout")
        rollout, weights = outcome["rollout"], self.scores["interim"].gather(1, batch.notes["bins"])
        new = student.sampled_direction(rollout, weights)
        # A checkpoint's tensors are on the CPU.
        before, self._direction = (
            {k: v.to(new[k]) for k, v in kept.items()} for kept in (self._gradient, self._direction)
        )
        self._gradient = {k: before[k] + v if before else v for k, v in new.items()}
        if not self._direction:
            return {}
        parts = student.sampled_alignment(self._direction, rollout)
        return {**dict(parts.items()), "steps": outcome["steps"]}

    def learn(self, evidence: TensorDict) -> None:
        """Averages the alignments of the levels that were trained on into their bins' scores."""
        score = self.scores["score"]
        aligned = alignments(evidence).to(score)
        means, counts = means_of_bins(evidence["bins"], aligned, score.shape[-1])
        averaged = self.smoothing * score + (1 - self.smoothing) * means
        self.scores = {**self.scores, "score": torch.where(counts > 0, averaged, score)}

    def shares(self) -> Tensor:
        """Returns the shares of the bins in the next batch, float [K, N]."""
        shares = super().shares()
        return (1 - self._exploration) * shares + self._exploration / shares.shape[-1]


def alignments(evidence: TensorDict) -> Tensor:
    """Returns the alignments of m levels of a batch, float [K, m].

    Where training standardises advantages over a batch, theirs are standardised over these levels.

    Args:
        evidence: what :meth:`SampledFirstOrderCurriculum.evidence` returns, [K, m].
    """
    aligned: Tensor = evidence["slope"]
    if "drift" not in evidence.keys():
        return aligned
    steps = evidence["steps"]
    count = steps.sum(-1, keepdim=True)
    mean, square = (
        (evidence[key] * steps).sum(-1, keepdim=True) / count for key in ("advantage", "square")
    )
    variance = (square - mean.square()).clamp_min(0) * count / (count - 1).clamp_min(1)
    return (aligned - mean * evidence["drift"]) / variance.sqrt().clamp_min(1e-6)
