"""ALP-GMM: draws levels where a mixture of Gaussians has seen absolute learning progress."""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from typing import Annotated, Any

import torch
from annotated_types import Interval
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.bins import CountingCurriculum
from proposer_rl.curricula.contract import Batch
from proposer_rl.curricula.points import Points, nearest
from proposer_rl.curricula.student import Student
from proposer_rl.extras import install_command
from proposer_rl.settings import ArgumentError, Share, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Space

LEAST_STORED = 6  # earlier episodes; with fewer, progress is 0
TwoOrMore = Annotated[int, Interval(ge=2, le=1_000_000)]


class MixtureCurriculum(CountingCurriculum):
    """Draws levels as points of a box, from Gaussians fitted to recent learning progress.

    A point of the box [-1, 1]^D, which the space's coordinates span, is rounded to a bin; the
    coordinates x of the bin are the task. The progress of an episode on x with return r is
    |r - r'|, where r' is the return on the nearest earlier task of the whole history. The first
    ``warmup`` points are uniform in the box. Then, after every ``refit`` episodes, a mixture of
    Gaussians is fitted to the points and the progress of the last ``refit`` episodes, and all but
    a part of the points are drawn from it (Portelas et al. 2019, arXiv 1910.07224, algorithm 1; see
    :func:`fit_mixture` and :func:`draw_points`).

    Mixtures are fitted to points, not bins, because on a grid the likelihood has no bound. Progress
    compares bins, not points, because the constant difference between two bins would pass for
    progress for ever.

    All episodes of a batch are played by the same student. So none of them is earlier than another,
    and each is compared with those of earlier batches; ties go to the last one.

    Args:
        space: that has the bins.
        warmup: number of episodes before the first mixture.
        refit: number of episodes between two mixtures, and to which one is fitted.
        components: largest number of Gaussians in a mixture; the smallest is two.
        exploration: share of the points that are uniform in the box.
        rounded: whether to round points to bins; otherwise points are levels and tasks themselves,
            which needs a space of continuous parameters (with a method ``at``).

    Raises:
        ValueError: if scikit-learn is missing, the numbers of episodes are not in order, or the
            space has a single bin.
    """

    state = ("_history", "_mixture", "_fitted", "_counts", "_drawn")

    @checked
    def __init__(
        self,
        space: Space,
        *,
        warmup: TwoOrMore = 250,
        refit: TwoOrMore = 250,
        components: TwoOrMore = 10,
        exploration: Share = 0.2,
        rounded: bool = True,
    ) -> None:
        self._points = Points(space, rounded)
        if find_spec("sklearn") is None:
            raise ValueError(
                f"alp_gmm: scikit-learn is missing; install it with: {install_command('alp-gmm')}"
            )
        if not components <= refit <= warmup:
            raise ArgumentError(
                f"components={components}: must be at most refit={refit}, and that at most "
                f"warmup={warmup}: a mixture is fitted to that many episodes"
            )
        super().__init__(space)
        self._components, self._refit = components, refit
        self._warmup, self._exploration = warmup, exploration
        # Points and tasks [H, D], returns and progress [H], float64 on the CPU.
        self._history: dict[str, Tensor] = {}
        self._mixture: list[Tensor] = []  # see fit_mixture
        self._fitted = 0  # episodes at the last fit
        self._drawn = torch.zeros(2, dtype=torch.int64)  # from mixtures, and clipped of these

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Draws points, and returns the levels [n] of the nearest bins."""
        self._fit(rng)
        points = self._draw(count, rng.generator("choices"))
        levels, bins = self._points.levels(points, rng)
        return Batch(levels, TensorDict({"bins": bins, "points": points}, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Adds tasks, returns and progress to the history."""
        super().observe(student, batch, outcome)
        notes = batch.notes
        points, returns = notes["points"], outcome["return"].double().cpu()
        tasks = self._points.tasks(points, notes["bins"])
        progress = torch.zeros_like(returns)
        if history := self._history:
            progress = absolute_progress(history["tasks"], history["returns"], tasks, returns)
        new = {"points": points, "tasks": tasks, "returns": returns, "progress": progress}
        self._history = {
            name: torch.cat([history[name], entry]) if history else entry
            for name, entry in new.items()
        }

    def log(self) -> dict[str, Any]:
        """Returns counts of levels by bin, the mixture, and how often a draw was clipped."""
        if not self._history:
            return {}
        drawn, clipped = self._drawn.tolist()
        self._drawn = torch.zeros_like(self._drawn)
        means = self._mixture[0].tolist() if self._mixture else []
        return {
            "histogram": self.histogram(),
            "progress": float(self._history["progress"][-self._refit :].mean()),
            "components": len(means),
            "means": means,
            "clipped": clipped / drawn if drawn else 0.0,
        }

    def _fit(self, rng: Streams) -> None:
        """Fits a new mixture if one is due."""
        episodes = len(self._history["returns"]) if self._history else 0
        due = episodes // self._refit > self._fitted // self._refit
        if episodes < self._warmup or not due:
            return
        last = {name: entry[-self._refit :] for name, entry in self._history.items()}
        seen = torch.cat([last["points"], last["progress"].unsqueeze(-1)], -1)  # [refit, D + 1]
        self._mixture = [*fit_mixture(seen, self._components, rng.generator("mixture"))]
        self._fitted = episodes

    def _draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draws points, float64 [n, D]."""
        uniform = (
            2 * torch.rand(count, self._points.size, generator=generator, dtype=torch.float64) - 1
        )
        if not self._mixture:
            return uniform
        explored = torch.rand(count, generator=generator) < self._exploration
        means, covariances = self._mixture
        drawn = draw_points(means, covariances, count, generator)
        kept = drawn.clamp(-1, 1)
        clipped = (kept != drawn).any(-1) & ~explored
        self._drawn = self._drawn + torch.stack([(~explored).sum(), clipped.sum()])
        return torch.where(explored.unsqueeze(-1), uniform, kept)


def fit_mixture(points: Tensor, most: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Fits mixtures of 2 to ``most`` Gaussians, and returns the one with the lowest AIC.

    Full covariances, expectation maximisation from one start by k-means
    (Portelas et al. 2019, arXiv 1910.07224, algorithm 1).

    Args:
        points: float [n, D + 1], n at least ``most``.
        most: components that are tried.
        generator: of the starts.

    Returns:
        The means of its J Gaussians, float64 [J, D + 1], the last coordinate being progress, and
        their covariances, float64 [J, D + 1, D + 1].
    """
    # Only this method needs it, and it takes a second to import.
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture
    from threadpoolctl import threadpool_limits

    data = points.double().numpy()
    seeds = torch.randint(2**31, (most - 1,), generator=generator).tolist()
    # Several threads would add up in any order, and the same run would not come out again.
    with warnings.catch_warnings(), threadpool_limits(1):
        # Fewer distinct points than components, or slow convergence: the AIC decides all the same.
        warnings.simplefilter("ignore", ConvergenceWarning)
        mixtures = [
            GaussianMixture(count, random_state=seed).fit(data)
            for count, seed in zip(range(2, most + 1), seeds, strict=True)
        ]
        best = min(mixtures, key=lambda one: float(one.aic(data)))
    return torch.from_numpy(best.means_), torch.from_numpy(best.covariances_)


def draw_points(
    means: Tensor, covariances: Tensor, count: int, generator: torch.Generator
) -> Tensor:
    """Draws points from a mixture's Gaussians, each in proportion to its mean's progress.

    Where no Gaussian has progress, all are alike.

    Args:
        means: of the Gaussians, as :func:`fit_mixture` gives them.
        covariances: likewise.
        count: number P of draws.
        generator: of the CPU.

    Returns:
        float64 [P, D].
    """
    progress = means[:, -1].clamp(min=0)
    weights = progress if bool(progress.sum() > 0) else torch.ones_like(progress)
    which = torch.multinomial(weights, count, replacement=True, generator=generator)
    # The marginal without the last coordinate has the other means and covariances.
    middles, spread = means[:, :-1], covariances[:, :-1, :-1]
    noise = torch.randn(count, middles.shape[1], 1, generator=generator, dtype=means.dtype)
    return middles[which] + (torch.linalg.cholesky(spread)[which] @ noise).squeeze(-1)


def absolute_progress(
    tasks: Tensor, returns: Tensor, new_tasks: Tensor, new_returns: Tensor
) -> Tensor:
    """Returns |r - r'| of new episodes, where r' is the return on the nearest earlier task.

    Portelas et al. 2019 (arXiv 1910.07224), equation of the absolute learning progress. As in their
    code, it is 0 as long as no more than five are stored.

    Args:
        tasks: the earlier ones, the oldest first, float [H, D].
        returns: on them, float [H].
        new_tasks: tasks of the new episodes, float [P, D].
        new_returns: returns of the new episodes, float [P].

    Returns:
        float [P].
    """
    if len(returns) < LEAST_STORED:
        return torch.zeros_like(new_returns)
    return (new_returns - returns[nearest(new_tasks, tasks)]).abs()
