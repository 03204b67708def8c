"""Curricula of new levels: plain samples, or the best of many candidates (SFL)."""

from __future__ import annotations

from typing import Any

import torch

from proposer_rl.curricula.batches import device_of
from proposer_rl.curricula.contract import Curriculum
from proposer_rl.curricula.scores import OwnScore, Scorer, Source
from proposer_rl.curricula.student import Student
from proposer_rl.learning import DivergedError
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import Count, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Levels


class SamplingCurriculum(Curriculum):
    """Draws every batch from one fixed distribution: the target, or domain randomization.

    Args:
        distribution: to draw from.
    """

    def __init__(self, distribution: Distribution) -> None:
        self._distribution = distribution

    def propose(self, student: Student, count: int, rng: Streams) -> Levels:
        """Draws levels [n]."""
        return self._distribution.sample(count, rng.generator("levels"))


class SelectionCurriculum(Curriculum):
    """Scores many candidates every few batches, and proposes the best of them and new levels.

    SFL (Rutherford et al. 2024, "No Regrets", arXiv 2408.15099, algorithm 1), with learnability as
    the score. The kept levels are drawn uniformly and with replacement; nothing is scored while the
    student trains.

    Args:
        space: from which levels are drawn.
        scorer: scores the candidates.
        candidates: number M of levels that are scored.
        keep: number of them that are kept.
        every: number of batches between two selections.
        new: share of new levels in a batch, rounded.

    Raises:
        DivergedError: in :meth:`propose`, if fewer candidates have a score than are to be kept.
    """

    state = ("scores", "kept", "_proposed")

    @checked
    def __init__(
        self,
        space: Distribution,
        scorer: Scorer,
        *,
        candidates: Count = 2048,
        keep: Count = 256,
        every: Count = 10,
        new: Share = 0.5,
    ) -> None:
        self.needs, self.required_results = scorer.needs, scorer.plays_for
        self._candidates, self._keep, self._every, self._new = candidates, keep, every, new
        self._new_levels, self.scorer = space, scorer
        self._proposed = 0
        self.kept: Levels = space.sample(1, torch.Generator())[:0]  # [keep], by falling score
        self.scores = torch.zeros(0)  # float64 [keep]

    @classmethod
    def create(
        cls,
        run: Components,
        *,
        score: str | OwnScore = "learnability",
        source: Source = "exact",
        rollouts: Count = 8,
        **settings: Any,
    ) -> SelectionCurriculum:
        """Makes it for a run's space, with a scorer; see :class:`Scorer`."""
        return cls(run.task.space, Scorer(score, source, rollouts), **settings)

    def propose(self, student: Student, count: int, rng: Streams) -> Levels:
        """Returns levels [n]: kept ones, then new ones.

        Raises:
            DivergedError: if fewer of the candidates have a score than are kept.
        """
        if self._proposed % self._every == 0:
            self._select(student, rng)
        self._proposed += 1
        fresh = round(self._new * count)
        draw = rng.generator("choices")
        which = torch.randint(self._keep, (count - fresh,), generator=draw)
        levels = self.kept[which]
        if fresh:
            levels = torch.cat([levels, self._new_levels.sample(fresh, rng.generator("levels"))])
        return levels

    def _select(self, student: Student, rng: Streams) -> None:
        """Scores new candidates and keeps the best."""
        levels = self._new_levels.sample(self._candidates, rng.generator("candidates"))
        scored = self.scorer(student, levels, rng)
        known = int(scored.score.isfinite().sum())
        if known < self._keep:
            raise DivergedError(
                f"on {known} of {self._candidates} candidates did an episode end within a rollout, "
                f"so fewer than {self._keep} have a score; try longer rollouts (the horizon)"
            )
        best = scored.score.sort(descending=True, stable=True)
        self.scores = best.values[: self._keep]
        self.kept = levels[best.indices[: self._keep].to(device_of(levels))]

    def log(self) -> dict[str, Any]:
        """Returns the scores of the kept levels."""
        if not len(self.kept):
            return {}
        return {
            "highest_score": float(self.scores[0]),
            "lowest_kept_score": float(self.scores[-1]),
            "mean_score": float(self.scores.mean()),
        }
