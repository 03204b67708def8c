"""Curricula in closed form: train on what raises the target's performance to first order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from proposer_rl.curricula.base import Improvement
from proposer_rl.curricula.bins import BinCurriculum, means_of_bins
from proposer_rl.curricula.checks import one_of, part, real, whole
from proposer_rl.curricula.choice import Choice
from proposer_rl.learning import PPO, Update
from proposer_rl.meta.first_order import (
    MEASURES,
    alignment,
    bin_scores,
    exact_alignment,
    exact_direction,
    ppo_advantages,
    surrogate,
    target_direction,
)
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask, ExactTask, Task


class _AlignedBins(BinCurriculum):
    """Draws each Solver's batch from bins by their scores.

    With s_n the exponential moving average of the n-th bin's score, its share of the batch is

        q_n  proportional to  exp( s_n / (temperature * max over n of |s_n|) ).

    Args:
        task: whose space has the bins.
        every: updates between two looks at the Solvers.
        temperature: of the shares.
        smoothing: share of the old score in the average.
        choice: see :class:`BinCurriculum`.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(
        self,
        task: Task,
        *,
        every: int,
        temperature: float,
        smoothing: float,
        choice: Choice | None,
    ) -> None:
        self._temperature = real("temperature", temperature, above=0)
        self.smoothing = part("smoothing", smoothing, below_one=True)
        super().__init__(task, every=every, choice=choice)

    def shares(self) -> Tensor:
        """Of the bins in the next batch, float [K, N]."""
        score = self.scores["score"]
        largest = score.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(score.dtype).tiny)
        return (score / (self._temperature * largest)).softmax(-1)


class FirstOrderCurriculum(_AlignedBins):
    """Scores each bin with the mean alignment of fresh levels of it, which nobody plays.

    What a level returns is exact (:mod:`proposer_rl.meta.first_order`): no frames are spent.

    Args:
        task: whose target is to be mastered.
        every: updates between two looks at the Solvers.
        temperature: the share of bin n is proportional to exp(s_n / (temperature * max |s|)), with
            s its averaged score.
        smoothing: share of the old score in the average.
        target_levels: fresh levels E of the target that the direction is taken from.
        candidates: levels C of each bin.
        step: of the differences that tell the alignments, in learning rates.
        measure: of the target's performance; see
            :func:`~proposer_rl.meta.first_order.target_performance`.
        choice: see :class:`BinCurriculum`.

    Raises:
        TypeError: if the task's performance has no gradients.
        ValueError: if a number is out of range.
    """

    def __init__(
        self,
        task: Task,
        *,
        every: int = 2,
        target_levels: int = 128,
        candidates: int = 8,
        step: float = 1.0,
        temperature: float = 0.1,
        smoothing: float = 0.9,
        measure: str = "log_success",
        choice: Choice | None = None,
    ) -> None:
        exact = require_gradients(task)
        super().__init__(
            task, every=every, temperature=temperature, smoothing=smoothing, choice=choice
        )
        self._exact = exact
        self._target_levels = whole("target_levels", target_levels, 1)
        self._candidates = whole("candidates", candidates, 1)
        self._step = real("step", step, above=0)
        self._measure = one_of("measure", measure, MEASURES)

    def look(self, learner: PPO, streams: Sequence[Streams]) -> tuple[int, int]:
        """Score every bin."""
        task, size, count = self._exact, self.task.space.size, self._candidates
        target = torch.stack(
            [task.target.sample(self._target_levels, s.generator("target")) for s in streams]
        )
        reached, direction = exact_direction(task, learner, target, self._measure)
        bins = torch.arange(size).repeat_interleave(count).expand(len(streams), -1)
        levels = task.space.generate(bins, [s.generator("candidates") for s in streams])
        found = exact_alignment(task, learner, direction, levels, self._step)
        score, error = (x.cpu() for x in bin_scores(found.unflatten(-1, (size, count))))
        old = self.smoothing if self.scores else 0.0
        before = self.scores or {"score": score, "variance": error.square()}
        self.scores = {
            "score": old * before["score"] + (1 - old) * score,
            "variance": old**2 * before["variance"] + (1 - old) ** 2 * error.square(),
            "target": reached.cpu(),
        }
        return 0, self._target_levels + 2 * count * size  # a candidate counts on either side

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """... and the scores' standard errors, and the target's performance at the last look."""
        told = super().improve(learner, updates, streams)
        if told.metrics:
            told.metrics["target_performance"] = self.scores["target"].tolist()
        if told.metrics and self._candidates > 1:
            shape = [len(values) for values in self.task.space.axes.values()]
            error = self.scores["variance"].sqrt()
            told.metrics["score_error"] = error.unflatten(-1, shape).tolist()
        return told


class SampledFirstOrderCurriculum(_AlignedBins):
    """The same from episodes, with any environment.

    The direction is the policy gradient of episodes that are played on the target, whose frames
    count; it is averaged as the scores are. The score of a bin is the mean alignment of the
    Solver's own training episodes on it, which cost nothing, so that a part of each batch goes to
    all bins alike.

    Where there is no success on the target there is no direction, but noise.

    Args:
        task: whose target is to be mastered.
        every: updates between two looks at the Solvers.
        temperature: the share of bin n is proportional to exp(s_n / (temperature * max |s|)), with
            s its averaged score.
        smoothing: share of the old score in the average.
        exploration: part of each batch that is drawn evenly.
        choice: see :class:`BinCurriculum`.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(
        self,
        task: Task,
        *,
        every: int = 1,
        temperature: float = 0.1,
        smoothing: float = 0.9,
        exploration: float = 0.2,
        choice: Choice | None = None,
    ) -> None:
        super().__init__(
            task, every=every, temperature=temperature, smoothing=smoothing, choice=choice
        )
        self._exploration = part("exploration", exploration)

    def begin(self) -> None:
        """Forget the last Solver's scores and direction."""
        super().begin()
        self._direction: dict[str, Tensor] = {}

    def look(self, learner: PPO, streams: Sequence[Streams]) -> tuple[int, int]:
        """Play a batch of the target."""
        task = self.task
        levels = [task.target.sample(task.batch_size, s.generator("target")) for s in streams]
        learner.env.set_levels(torch.stack(levels))
        rollout = learner.collect([s.generator("target_actions") for s in streams])
        with torch.enable_grad():
            worth = surrogate(learner.agent, rollout, ppo_advantages(learner, rollout)).mean(1)
            found = target_direction(learner, worth)
        old = self.smoothing if self._direction else 0.0
        before = self._direction or found
        self._direction = {name: old * before[name] + (1 - old) * found[name] for name in found}
        if not self.scores:
            self.scores = {"score": torch.zeros(len(streams), task.space.size)}
        return rollout[0].numel(), 0

    def observe(self, learner: PPO, levels: Any, update: Update) -> None:
        """Score the bins that were trained on, as the Solver stands after its update."""
        rollout, score = update.rollout, self.scores["score"]
        advantage = ppo_advantages(learner, rollout)
        found = alignment(
            learner.agent,
            self._direction,
            learner.settings.learning_rate,
            lambda: surrogate(learner.agent, rollout, advantage),
        ).to(score)
        means, counts = means_of_bins(self._choices, found, score.shape[-1])
        averaged = self.smoothing * score + (1 - self.smoothing) * means
        self.scores = {"score": torch.where(counts > 0, averaged, score)}

    def shares(self) -> Tensor:
        """Of the bins in the next batch, float [K, N]."""
        shares = super().shares()
        return (1 - self._exploration) * shares + self._exploration / shares.shape[-1]

    def state_dict(self) -> dict[str, Any]:
        """The direction too."""
        return {**super().state_dict(), "direction": dict(self._direction)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        super().load_state_dict(state)
        # A checkpoint's tensors are on the CPU.
        self._direction = {k: v.to(self.task.device) for k, v in state["direction"].items()}


def require_gradients(task: Task) -> ExactTask:
    """The task, if its performance has gradients; else a TypeError."""
    if not isinstance(task, DifferentiableTask):
        raise TypeError(
            f"first-order gain needs gradients: {type(task).__name__} must define "
            "differentiable_performance(agent, levels); +method=first_order_sampled needs none"
        )
    exact: Any = task
    return exact
