"""ALP-GMM: levels from where a mixture of Gaussians has seen absolute learning progress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.bins import BinCounts
from proposer_rl.curricula.checks import one_of, part, whole
from proposer_rl.curricula.contract import Batch, Curriculum, Inbox
from proposer_rl.curricula.mixtures import TaskMixture, draw, fit, require_scikit_learn
from proposer_rl.curricula.student import Student
from proposer_rl.streams import Streams
from proposer_rl.task import Space

LEAST_STORED = 6  # earlier episodes, below which there is no progress to tell
CHUNK = 2**16  # earlier episodes that are compared at once
SOURCES = ("episodes", "exact")


class MixtureCurriculum(Curriculum):
    """Draws each student's levels as points of a box, and rounds them to the space's bins.

    A point of the box [-1, 1]^D that the space's coordinates span is rounded to a bin, whose
    coordinates x are the task. The progress of an episode on x with return r is |r - r'|, with r'
    that of the nearest earlier task in the student's whole history. The first ``warmup`` points are
    drawn uniformly from the box; then, at every ``refit`` episodes, a mixture of Gaussians is
    fitted to the points and the progress of the last ``refit``, from which all but a part of the
    draws come (Portelas et al. 2019, arXiv 1910.07224, algorithm 1; see
    :mod:`~proposer_rl.curricula.mixtures`).

    Points and not bins are what mixtures are fitted to: on a grid the likelihood has no bound.
    Bins and not points are compared: between two points with a border of bins in between, the
    difference of the bins would pass for progress for ever.

    The episodes of one batch are played by one and the same student: none of them is earlier than
    another, and each is compared with those of earlier batches. Of equally near ones the last
    counts.

    Args:
        space: that has the bins.
        source: of the return: ``"episodes"`` for what came of training on the level; ``"exact"``
            for the student's performance on it when it was proposed, which costs an evaluation and
            is exact where that is.
        warmup: episodes before the first mixture.
        refit: episodes between two mixtures, and that one is fitted to.
        components: the most Gaussians of a mixture; there are at least two.
        exploration: part of the draws that come uniformly from the box.

    Raises:
        ValueError: if a value is out of range, or scikit-learn is missing.
    """

    def __init__(
        self,
        space: Space,
        *,
        source: str = "episodes",
        warmup: int = 250,
        refit: int = 250,
        components: int = 10,
        exploration: float = 0.2,
    ) -> None:
        require_scikit_learn()
        self.space = space
        self._source = one_of("source", source, SOURCES)
        self._components = whole("components", components, 2)
        self._refit = whole("refit", refit, 2)
        self._warmup = whole("warmup", warmup, 2)
        self._exploration = part("exploration", exploration)
        if not self._components <= self._refit <= self._warmup:
            raise ValueError(
                f"components={components} must be at most refit={refit}, and that at most "
                f"warmup={warmup}: a mixture is fitted to that many episodes"
            )
        # Points and tasks [K, H, D], returns and progress [K, H], float64 on the CPU.
        self._history: dict[str, Tensor] = {}
        self._mixtures: list[TaskMixture] = []  # of each student
        self._fitted = 0  # episodes at the last fit
        self._inbox = Inbox()
        self._counts = BinCounts(space)
        self._drawn = torch.zeros(2, dtype=torch.int64)  # from mixtures, and clipped of these

    @property
    def needs(self) -> tuple[str, ...]:
        """The performance, where it is the source."""
        return ("performance",) if self._source == "exact" else ()

    @property
    def episodes(self) -> int:
        """Episodes H in the history of each student."""
        return self._history["returns"].shape[1] if self._history else 0

    def propose(self, student: Student, count: int, streams: Sequence[Streams]) -> Batch:
        """Levels [K, n] of the bins nearest to the points drawn."""
        self._take_in()
        self._fit(streams)
        drawn = [self._draw(k, count, s.generator("choices")) for k, s in enumerate(streams)]
        points = torch.stack(drawn)
        bins = nearest(points.flatten(0, 1), self.space.coordinates.double()).view(points.shape[:2])
        levels = self.space.generate(bins, [s.generator("levels") for s in streams])
        notes = {"bins": bins, "points": points}
        if self._source == "exact":
            reached = student.performance(levels, streams[0].generator("performance"))["return"]
            notes["returns"] = reached.double().cpu()
        return self._inbox.batch(levels, **notes)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Put tasks and returns aside for the histories."""
        self._inbox.check(batch, outcome)
        notes = batch.notes
        self._counts.add(notes["bins"])
        returns = outcome["return"].double() if self._source == "episodes" else notes["returns"]
        self._inbox.put(batch, points=notes["points"], bins=notes["bins"], returns=returns)

    def log(self) -> dict[str, Any]:
        """Counts, the mixtures, and how often a draw was clipped."""
        self._take_in()
        if not self._history:
            return {}
        drawn, clipped = self._drawn.tolist()
        self._drawn = torch.zeros_like(self._drawn)
        return {
            "histogram": self._counts.histogram(),
            "progress": self._history["progress"][:, -self._refit :].mean(1).tolist(),
            "components": [len(mixture.means) for mixture in self._mixtures],
            "means": [mixture.means.tolist() for mixture in self._mixtures],
            "clipped": clipped / drawn if drawn else 0.0,
        }

    def state_dict(self) -> dict[str, Any]:
        """Histories, mixtures, and what is logged."""
        return {
            "history": dict(self._history),
            "mixtures": [mixture._asdict() for mixture in self._mixtures],
            "fitted": self._fitted,
            "counts": self._counts.counts,
            "drawn": self._drawn,
            "inbox": self._inbox.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        self._history = dict(state["history"])
        self._mixtures = [TaskMixture(**mixture) for mixture in state["mixtures"]]
        self._fitted = state["fitted"]
        self._counts.counts, self._drawn = state["counts"], state["drawn"]
        self._inbox.load_state_dict(state["inbox"])

    def _take_in(self) -> None:
        """Add tasks, returns and progress to the histories."""
        for evidence in self._inbox.take():
            self._remember(evidence)

    def _remember(self, evidence: TensorDict) -> None:
        tasks, returns = self.space.coordinates.double()[evidence["bins"]], evidence["returns"]
        progress = torch.zeros_like(returns)
        if history := self._history:
            past = zip(history["tasks"], history["returns"], tasks, returns, strict=True)
            progress = torch.stack([absolute_progress(*own) for own in past])
        new = {
            "points": evidence["points"],
            "tasks": tasks,
            "returns": returns,
            "progress": progress,
        }
        self._history = {
            name: torch.cat([history[name], entry], 1) if history else entry
            for name, entry in new.items()
        }

    def _fit(self, streams: Sequence[Streams]) -> None:
        """Fit new mixtures if it is time."""
        due = self.episodes // self._refit > self._fitted // self._refit
        if self.episodes < self._warmup or not due:
            return
        last = {name: entry[:, -self._refit :] for name, entry in self._history.items()}
        seen = torch.cat([last["points"], last["progress"].unsqueeze(-1)], -1)  # [K, refit, D + 1]
        self._mixtures = [
            fit(own, self._components, s.generator("mixture"))
            for own, s in zip(seen, streams, strict=True)
        ]
        self._fitted = self.episodes

    def _draw(self, student: int, count: int, generator: torch.Generator) -> Tensor:
        """A batch of points for one student, float64 [n, D]."""
        size = self.space.coordinates.shape[1]
        uniform = 2 * torch.rand(count, size, generator=generator, dtype=torch.float64) - 1
        if not self._mixtures:
            return uniform
        explored = torch.rand(count, generator=generator) < self._exploration
        drawn = draw(self._mixtures[student], count, generator)
        kept = drawn.clamp(-1, 1)
        clipped = (kept != drawn).any(-1) & ~explored
        self._drawn = self._drawn + torch.stack([(~explored).sum(), clipped.sum()])
        return torch.where(explored.unsqueeze(-1), uniform, kept)


def nearest(points: Tensor, places: Tensor) -> Tensor:
    """The place nearest to each point, the last of equally near ones.

    Args:
        points: float [n, D].
        places: float [m, D], m at least 1.

    Returns:
        int64 [n].

    Example:
        >>> nearest(torch.tensor([[0.9], [0.5]]), torch.tensor([[0.0], [1.0], [1.0]]))
        tensor([2, 2])
    """
    best = torch.full((len(points),), torch.inf, dtype=points.dtype)
    found = torch.zeros(len(points), dtype=torch.int64)
    for start in range(0, len(places), CHUNK):
        some = places[start : start + CHUNK].flip(0)  # min takes the first, flipped the last
        # Through a matrix product, equal distances would not come out equal.
        apart = torch.cdist(points, some, compute_mode="donot_use_mm_for_euclid_dist")
        least, index = apart.min(1)
        found = torch.where(least <= best, start + len(some) - 1 - index, found)
        best = torch.minimum(best, least)
    return found


def absolute_progress(
    tasks: Tensor, returns: Tensor, new_tasks: Tensor, new_returns: Tensor
) -> Tensor:
    """|r - r'| of new episodes, r' the return on the nearest of earlier tasks; else 0.

    Portelas et al. 2019 (arXiv 1910.07224), equation of the absolute learning progress. As in their
    code, it is 0 as long as no more than five are stored.

    Args:
        tasks: the earlier ones, the oldest first, float [H, D].
        returns: on them, float [H].
        new_tasks: those of the new episodes, float [P, D].
        new_returns: on them, float [P].

    Returns:
        float [P].
    """
    if len(returns) < LEAST_STORED:
        return torch.zeros_like(new_returns)
    return (new_returns - returns[nearest(new_tasks, tasks)]).abs()
