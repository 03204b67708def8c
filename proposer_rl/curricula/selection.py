"""A curriculum that picks the best of many candidates now and then: Sampling for Learnability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from proposer_rl.curricula.base import Curriculum, Improvement, Proposal
from proposer_rl.curricula.batches import (
    fresh_levels,
    levels_at,
)
from proposer_rl.curricula.checks import part, whole
from proposer_rl.curricula.scores import Scorer
from proposer_rl.learning import PPO, DivergedError
from proposer_rl.streams import Streams
from proposer_rl.task import Levels

SHOWN = 6  # levels that a reader is shown


class SelectionCurriculum(Curriculum):
    """Scores many new levels every few updates, and trains on the best of them and on new ones.

    SFL (Rutherford et al. 2024, "No Regrets", arXiv 2408.15099, algorithm 1), with learnability as
    the score. The levels that are kept are drawn evenly and with replacement; nothing is scored
    while the Solver trains.

    Args:
        scorer: which knows the task, and scores its levels.
        candidates: levels M of the space that are scored for each Solver, a multiple of an
            update's levels.
        keep: of them.
        every: updates between two such selections.
        new: share of a batch that is drawn from the space instead, rounded.

    Raises:
        ValueError: if a number is out of range.
    """

    def __init__(
        self, scorer: Scorer, *, candidates: int, keep: int, every: int, new: float
    ) -> None:
        size = scorer.task.batch_size
        if whole("candidates", candidates, 1) % size:
            raise ValueError(
                f"candidates={candidates} must be a multiple of the {size} levels of an update"
            )
        if whole("keep", keep, 1) > candidates:
            raise ValueError(f"keep={keep} must be at most candidates={candidates}")
        self._every, self._new = whole("every", every, 1), round(part("new", new) * size)
        self._candidates, self._keep = candidates, keep
        self.scorer, self.task = scorer, scorer.task
        self._template = self.task.space.sample(1, torch.Generator()).cpu()[0]
        self.begin()

    def begin(self) -> None:
        """Forget what was selected for the last Solver."""
        self.kept: Levels | None = None  # [K, keep], by falling score
        self.scores = torch.zeros(0)  # float64 [K, keep]

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [K, P]: some of those kept, then new ones."""
        cost = 0, 0
        if self.kept is None or updates % self._every == 0:
            cost = self._select(learner, streams)
        count = self.task.batch_size - self._new
        draws = [s.generator("choices") for s in streams]
        which = torch.stack([torch.randint(self._keep, (count,), generator=g) for g in draws])
        levels = levels_at(self.kept, which).to(self.task.device)
        if self._new:
            new = fresh_levels(self.task.space, self._new, streams, "levels")
            levels = torch.cat([levels, new], 1)
        return Proposal(levels, *cost)

    def _select(self, learner: PPO, streams: Sequence[Streams]) -> tuple[int, int]:
        """Keep the best of new candidates; the frames and evaluations that it cost.

        Raises:
            DivergedError: if fewer have a score than are kept.
        """
        levels = fresh_levels(self.task.space, self._candidates, streams, "candidates")
        scored, frames, evaluations = self.scorer(learner, levels, streams)
        known = int(scored.score.isfinite().sum(-1).min())
        if known < self._keep:
            raise DivergedError(
                f"solver.ppo.horizon={learner.settings.horizon}: on {known} of "
                f"{self._candidates} candidates did an episode end within it, so that fewer than "
                f"{self._keep} have a score"
            )
        best = scored.score.sort(dim=-1, descending=True, stable=True)
        self.scores = best.values[:, : self._keep]
        self.kept = levels_at(levels.cpu(), best.indices[:, : self._keep])
        return frames, evaluations

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Tell of the scores of what is kept, and show the first Solver's best."""
        if self.kept is None:
            return Improvement()
        metrics = {
            "highest_score": self.scores[:, 0].tolist(),
            "lowest_kept_score": self.scores[:, -1].tolist(),
            "mean_score": self.scores.mean(1).tolist(),
            "levels": {"highest scores": self.task.record(self.kept[0, :SHOWN], None)},
        }
        return Improvement(metrics)

    def state_dict(self) -> dict[str, Any]:
        """What is kept."""
        kept = None if self.kept is None else self.kept.to_dict(convert_tensors=False)
        return {"kept": kept, "scores": self.scores.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with it."""
        kept, self.scores = state["kept"], state["scores"].clone()
        shape = self.scores.shape
        kind = type(self._template)
        self.kept = None if kept is None else kind.from_dict(kept, batch_size=shape)
