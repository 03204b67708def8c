"""A curriculum in closed form: train on what raises the target's performance to first order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from proposer_rl.curricula.base import Curriculum, Improvement, Proposal
from proposer_rl.learning.ppo import PPO
from proposer_rl.meta.actions import systematic_draw
from proposer_rl.meta.first_order import bin_scores, exact_alignment, exact_direction
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask, Task


class ExactTask(Task, DifferentiableTask, Protocol):
    """A task whose performance has gradients."""


def require_gradients(task: object) -> None:
    """Raise a TypeError if the task's performance has none."""
    if not isinstance(task, DifferentiableTask):
        raise TypeError(
            f"first-order gain needs gradients: {type(task).__name__} must define "
            "differentiable_performance(agent, levels)"
        )


class FirstOrderCurriculum(Curriculum):
    """Draws each batch from the bins whose levels are best aligned with the target direction.

    At every update each bin is scored with the mean alignment of fresh levels of it, their
    candidates (:mod:`proposer_rl.meta.first_order`), which are evaluated, not played. The scores
    s are averaged over time; bin n then has the share

        q_n  proportional to  exp( s_n / (temperature * max over n of |s_n|) )

    of the batch. Each Solver has its own direction, scores and shares.

    Args:
        task: whose target is to be mastered, and whose space has the bins.
        every: updates between two scorings.
        target_levels: fresh levels E of the target that the direction is taken from.
        candidates: levels C of each bin.
        temperature: of the shares.
        smoothing: share of the old scores in the new ones' exponential moving average.
        measure: of the target's performance; see :func:`target_performance`.

    Raises:
        TypeError: if the task's performance has no gradients.
        ValueError: if a number is out of range.
    """

    def __init__(
        self,
        task: ExactTask,
        *,
        every: int = 1,
        target_levels: int = 256,
        candidates: int = 16,
        temperature: float = 0.1,
        smoothing: float = 0.9,
        measure: str = "log_success",
    ) -> None:
        require_gradients(task)
        if min(every, target_levels, candidates) < 1:
            raise ValueError(
                "every, target_levels and candidates must be at least 1, got "
                f"{every}, {target_levels}, {candidates}"
            )
        if not temperature > 0 or not 0 <= smoothing < 1:
            raise ValueError(
                "temperature must be above 0 and smoothing from 0 to below 1, got "
                f"{temperature}, {smoothing}"
            )
        self._task = task
        self._every = every
        self._target_levels = target_levels
        self._candidates = candidates
        self._temperature = temperature
        self._smoothing = smoothing
        self._measure = measure
        self.begin()

    def begin(self) -> None:
        """Forget the last Solver's scores."""
        self._scores: dict[str, Tensor] = {}
        self._proposed = torch.zeros(self._task.space.size, dtype=torch.int64)

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [K, P], drawn systematically from the shares."""
        evaluations = 0
        if updates % self._every == 0 or not self._scores:
            self._score(learner, streams)
            size = self._task.space.size
            evaluations = self._target_levels + 2 * self._candidates * size  # one on either side
        draws, levels = ([s.generator(key) for s in streams] for key in ("choices", "levels"))
        choices = systematic_draw(self.shares(), self._task.batch_size, draws)
        self._proposed += choices.flatten().bincount(minlength=len(self._proposed))
        return Proposal(self._task.space.generate(choices, levels), evaluations=evaluations)

    def shares(self) -> Tensor:
        """Of the bins in the next batch, float [K, N]."""
        score = self._scores["score"]
        largest = score.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(score.dtype).tiny)
        return (score / (self._temperature * largest)).softmax(-1)

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Tell of the last cycle."""
        if not self._scores:
            return Improvement()
        shares = self.shares()
        shape = [len(values) for values in self._task.space.axes.values()]
        metrics = {
            "histogram": self._proposed.view(shape).tolist(),
            "score": self._scores["score"].unflatten(-1, shape).tolist(),
            "score_error": self._scores["variance"].sqrt().unflatten(-1, shape).tolist(),
            "target_performance": self._scores["target"].tolist(),
            "share_entropy": (-shares * shares.clamp_min(1e-30).log()).sum(-1).tolist(),
            "effective_bins": (1 / shares.square().sum(-1)).tolist(),
        }
        self._proposed = torch.zeros_like(self._proposed)
        return Improvement(metrics)

    def state_dict(self) -> dict[str, Any]:
        """The scores, and how often each bin was proposed in the cycle."""
        return {"scores": dict(self._scores), "proposed": self._proposed.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        self._scores = dict(state["scores"])
        self._proposed = state["proposed"].clone()

    def _score(self, learner: PPO, streams: Sequence[Streams]) -> None:
        target = torch.stack(
            [self._task.target.sample(self._target_levels, s.generator("target")) for s in streams]
        )
        reached, direction = exact_direction(self._task, learner, target, self._measure)
        size, count = self._task.space.size, self._candidates
        bins = torch.arange(size).repeat_interleave(count).expand(len(streams), -1)
        levels = self._task.space.generate(bins, [s.generator("candidates") for s in streams])
        found = exact_alignment(self._task, learner, direction, levels)
        score, error = (x.cpu() for x in bin_scores(found.unflatten(-1, (size, count))))
        if self._scores:
            old = self._smoothing
            score = old * self._scores["score"] + (1 - old) * score
            variance = old**2 * self._scores["variance"] + (1 - old) ** 2 * error.square()
        else:
            variance = error.square()
        self._scores = {"score": score, "variance": variance, "target": reached.cpu()}
