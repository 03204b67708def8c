"""ALP-GMM: levels from where a mixture of Gaussians has seen absolute learning progress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from proposer_rl.curricula.base import Curriculum, Improvement, Proposal
from proposer_rl.curricula.checks import one_of, part, whole
from proposer_rl.curricula.mixtures import TaskMixture, draw, fit, require_scikit_learn
from proposer_rl.learning import PPO, Update, first_episode_return
from proposer_rl.streams import Streams
from proposer_rl.task import Task

LEAST_STORED = 6  # earlier episodes, below which there is no progress to tell
CHUNK = 2**16  # earlier episodes that are compared at once
SOURCES = ("episodes", "exact")


class MixtureCurriculum(Curriculum):
    """Draws each Solver's levels as points of a box, and rounds them to the space's bins.

    A point of the box [-1, 1]^D that the space's coordinates span is rounded to a bin, whose
    coordinates x are the task. The progress of an episode on x with return r is |r - r'|, with r'
    that of the nearest earlier task in the Solver's whole history. The first ``warmup`` points are
    drawn evenly from the box; then, at every ``refit`` episodes, a mixture of Gaussians is fitted
    to the points and the progress of the last ``refit``, from which all but a part of the draws
    come (Portelas et al. 2019, arXiv 1910.07224, algorithm 1; see
    :mod:`~proposer_rl.curricula.mixtures`).

    Points and not bins are what mixtures are fitted to: on a grid the likelihood has no bound.
    Bins and not points are compared: between two points with a border of bins in between, the
    difference of the bins would pass for progress for ever.

    The episodes of one update are played by one and the same Solver: none of them is earlier than
    another, and each is compared with those of earlier updates. Of equally near ones the last
    counts.

    Args:
        task: whose space has the bins.
        source: of the return: ``"episodes"`` for the first one of each level in the Solver's
            training; ``"exact"`` for what the task tells of the level, which costs an
            evaluation of each and is exact where that is.
        warmup: episodes before the first mixture.
        refit: episodes between two mixtures, and that one is fitted to.
        components: the most Gaussians of a mixture; there are at least two.
        exploration: part of the draws that come evenly from the box.

    Raises:
        ValueError: if a value is out of range, or scikit-learn is missing.
    """

    def __init__(
        self,
        task: Task,
        *,
        source: str = "episodes",
        warmup: int = 250,
        refit: int = 250,
        components: int = 10,
        exploration: float = 0.2,
    ) -> None:
        require_scikit_learn()
        self.task = task
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
        self.begin()

    def begin(self) -> None:
        """Forget the last Solver: its history and its mixture."""
        # Points and tasks [K, H, D], returns and progress [K, H], float64 on the CPU.
        self._history: dict[str, Tensor] = {}
        self._mixtures: list[TaskMixture] = []  # of each Solver
        self._fitted = 0  # episodes at the last fit
        self._asked: dict[str, Tensor] = {}
        self._forget_cycle()

    def _forget_cycle(self) -> None:
        self._proposed = torch.zeros(self.task.space.size, dtype=torch.int64)
        self._drawn = torch.zeros(2, dtype=torch.int64)  # from mixtures, and clipped of these

    @property
    def episodes(self) -> int:
        """Episodes H in the history of each Solver."""
        return self._history["returns"].shape[1] if self._history else 0

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [K, P] of the bins nearest to the points drawn."""
        self._fit(streams)
        places = self.task.space.coordinates.double()
        points = torch.stack([self._draw(k, s.generator("choices")) for k, s in enumerate(streams)])
        choices = nearest(points.flatten(0, 1), places).view(points.shape[:2])  # [K, P]
        levels = self.task.space.generate(choices, [s.generator("levels") for s in streams])
        self._proposed += choices.flatten().bincount(minlength=len(self._proposed))
        self._asked = {"points": points, "tasks": places[choices]}
        if self._source == "episodes":
            return Proposal(levels)
        draws = streams[0].generator("performance")
        with torch.no_grad():
            reached = self.task.performance(learner.agent, levels, draws)["return"]
        self._asked["returns"] = reached.double().cpu()
        return Proposal(levels, evaluations=self.task.batch_size)

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

    def _draw(self, solver: int, generator: torch.Generator) -> Tensor:
        """A batch of points for one Solver, float64 [P, D]."""
        count, size = self.task.batch_size, self.task.space.coordinates.shape[1]
        even = 2 * torch.rand(count, size, generator=generator, dtype=torch.float64) - 1
        if not self._mixtures:
            return even
        explored = torch.rand(count, generator=generator) < self._exploration
        drawn = draw(self._mixtures[solver], count, generator)
        kept = drawn.clamp(-1, 1)
        clipped = (kept != drawn).any(-1) & ~explored
        self._drawn += torch.stack([(~explored).sum(), clipped.sum()])
        return torch.where(explored.unsqueeze(-1), even, kept)

    def observe(self, learner: PPO, levels: Any, update: Update) -> None:
        """Add the update's tasks, returns and progress to the histories."""
        if self._source == "episodes":
            self._asked["returns"] = first_episode_return(update.rollout).double().cpu()
        new = dict(self._asked)
        tasks, returns = new["tasks"], new["returns"]
        if not self._history:
            new["progress"] = torch.zeros_like(returns)
            self._history = new
            return
        history = self._history
        new["progress"] = torch.stack(
            [
                absolute_progress(history["tasks"][k], history["returns"][k], tasks[k], returns[k])
                for k in range(len(tasks))
            ]
        )
        self._history = {name: torch.cat([history[name], new[name]], 1) for name in history}

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Tell of the last cycle: counts, the mixtures, and how often a draw was clipped."""
        if not self._history:
            return Improvement()
        shape = [len(values) for values in self.task.space.axes.values()]
        drawn, clipped = self._drawn.tolist()
        metrics = {
            "histogram": self._proposed.view(shape).tolist(),
            "progress": self._history["progress"][:, -self._refit :].mean(1).tolist(),
            "components": [len(mixture.means) for mixture in self._mixtures],
            "means": [mixture.means.tolist() for mixture in self._mixtures],
            "clipped": clipped / drawn if drawn else 0.0,
        }
        self._forget_cycle()
        return Improvement(metrics)

    def state_dict(self) -> dict[str, Any]:
        """Histories, mixtures, and what is told of the cycle."""
        return {
            "history": dict(self._history),
            "mixtures": [mixture._asdict() for mixture in self._mixtures],
            "fitted": self._fitted,
            "proposed": self._proposed.clone(),
            "drawn": self._drawn.clone(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        self._history = dict(state["history"])
        self._mixtures = [TaskMixture(**mixture) for mixture in state["mixtures"]]
        self._fitted = state["fitted"]
        self._proposed, self._drawn = state["proposed"].clone(), state["drawn"].clone()


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
