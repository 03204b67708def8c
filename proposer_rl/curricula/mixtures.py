"""Gaussian mixtures of points in the space of tasks and of learning progress, for ALP-GMM."""

from __future__ import annotations

import warnings
from importlib.util import find_spec
from typing import NamedTuple

import torch
from torch import Tensor

from proposer_rl.extras import install_command


class TaskMixture(NamedTuple):
    """Gaussians over points and progress; the last of the D + 1 coordinates is progress.

    Attributes:
        means: float64 [J, D + 1].
        covariances: float64 [J, D + 1, D + 1].
    """

    means: Tensor
    covariances: Tensor


def require_scikit_learn() -> None:
    """Check that mixtures can be fitted.

    Raises:
        ValueError: if scikit-learn is not installed.
    """
    if find_spec("sklearn") is None:
        raise ValueError(
            f"alp_gmm: scikit-learn is missing; install it with: {install_command('alp-gmm')}"
        )


def fit(points: Tensor, most: int, generator: torch.Generator) -> TaskMixture:
    """The mixture of 2 to ``most`` Gaussians with the least AIC.

    Full covariances, expectation maximisation from one start by k-means
    (Portelas et al. 2019, arXiv 1910.07224, algorithm 1).

    Args:
        points: float [n, D + 1], n at least ``most``.
        most: components that are tried.
        generator: of the starts.
    """
    # Only this method needs it, and it takes a second to import.
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.mixture import GaussianMixture
    from threadpoolctl import threadpool_limits

    data = points.double().numpy()
    seeds = torch.randint(2**31, (most - 1,), generator=generator).tolist()
    # Several threads would add up in any order, and the same run would not come out again.
    with warnings.catch_warnings(), threadpool_limits(1):
        # Fewer distinct points than components, or slow convergence: the AIC decides on what came.
        warnings.simplefilter("ignore", ConvergenceWarning)
        found = [
            GaussianMixture(count, random_state=seed).fit(data)
            for count, seed in zip(range(2, most + 1), seeds, strict=True)
        ]
        best = min(found, key=lambda mixture: float(mixture.aic(data)))
    return TaskMixture(torch.from_numpy(best.means_), torch.from_numpy(best.covariances_))


def draw(mixture: TaskMixture, count: int, generator: torch.Generator) -> Tensor:
    """Points of the mixture's Gaussians, each chosen in proportion to its mean's progress.

    Where no Gaussian has progress, all are alike.

    Args:
        mixture: of points with D coordinates.
        count: number P of draws.
        generator: of the CPU.

    Returns:
        float64 [P, D].
    """
    progress = mixture.means[:, -1].clamp(min=0)
    weights = progress if bool(progress.sum() > 0) else torch.ones_like(progress)
    chosen = torch.multinomial(weights, count, replacement=True, generator=generator)
    # Without its last coordinate a Gaussian is one of the others' means and covariances.
    means, spread = mixture.means[:, :-1], mixture.covariances[:, :-1, :-1]
    noise = torch.randn(count, means.shape[1], 1, generator=generator, dtype=means.dtype)
    return means[chosen] + (torch.linalg.cholesky(spread)[chosen] @ noise).squeeze(-1)
