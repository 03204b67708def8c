"""Self-paced learning (SPDL): a Gaussian moves to the target as fast as performance allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.bins import CountingCurriculum, Measure
from proposer_rl.curricula.contract import Batch
from proposer_rl.curricula.points import Place, Points
from proposer_rl.curricula.student import Student
from proposer_rl.meta.assembly import Components
from proposer_rl.settings import Count, Positive, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Distribution, Space

Floats = NDArray[np.float64]
Goal = Callable[[Floats], tuple[float, Floats]]  # a value and its gradient
Deviation = Annotated[float, Interval(gt=0, le=2)]

WIDEST = 2.0  # standard deviation at which a Gaussian is nearly uniform in the box
SAMPLED = 1000  # levels of the target from which its mean and deviation are estimated
SLACK = 1e-4  # violation of the constraints at which a solution is still accepted


class SelfPacedCurriculum(CountingCurriculum):
    """Draws levels from a Gaussian that moves towards the target's.

    A level is a point of the box [-1, 1]^D, which the space's coordinates span. Points come from a
    normal distribution with independent coordinates, truncated to the box. After every ``episodes``
    results, mean and deviations of the distribution p change: they minimise the Kullback-Leibler
    divergence KL(p, target) subject to KL(p, current one) of at most ``epsilon`` and an expected
    performance of at least ``delta`` (Klink et al. 2021, "A Probabilistic Interpretation of
    Self-Paced Learning with Applications to Reinforcement Learning", JMLR 22; Klink et al. 2020,
    arXiv 2004.11812, use a penalty instead). The target is represented by the Gaussian with its
    mean and deviations. See :func:`step_towards`.

    Args:
        space: that has the bins.
        target: the distribution to master.
        target_shares: the target as shares of the bins, float [N].
        delta: least expected performance.
        epsilon: largest divergence of a step.
        episodes: number of results between two steps, by which performance is estimated.
        start: where the mean begins, from -1 for the first to 1 for the last value of an axis, by
            the axis's name; 0, the middle, for other axes.
        deviation: initial standard deviation.
        least_deviation: smallest standard deviation of the distribution and of the target.
        measure: of performance, ``"success"`` or ``"return"``.
        rounded: see :class:`~proposer_rl.curricula.points.Points`.

    Attributes:
        mean, deviation: of the distribution, float64 [D].

    Raises:
        ValueError: for an unknown axis, or a space that has no points.
    """

    state = ("mean", "deviation", "_episodes", "_expected", "_counts")

    @checked
    def __init__(
        self,
        space: Space,
        target: Distribution,
        target_shares: Tensor,
        *,
        delta: float = 0.3,
        epsilon: Positive = 0.05,
        episodes: Count = 80,
        start: dict[str, Place] | None = None,
        deviation: Deviation = 0.5,
        least_deviation: Deviation = 0.01,
        measure: Measure = "success",
        rounded: bool = True,
    ) -> None:
        super().__init__(space)
        self._points = Points(space, rounded)
        self.required_results = ("success",) if measure == "success" else ()
        self._limits = delta, epsilon, least_deviation
        self._every, self._measure = episodes, measure
        if rounded:
            places = space.coordinates.double()
            shares = (target_shares.double() / target_shares.double().sum()).unsqueeze(-1)
        else:
            place: Any = space  # only one of continuous parameters knows the points of levels
            places = place.place(target.sample(SAMPLED, Streams(0).generator("target")))
            shares = torch.full((SAMPLED, 1), 1 / SAMPLED, dtype=torch.float64)
        middle = (shares * places).sum(0)
        spread = (shares * (places - middle).square()).sum(0).sqrt()
        self._target = Gaussian(middle.numpy(), spread.clamp(min=least_deviation).numpy())
        self.mean, self.deviation = self._points.at(start), torch.full_like(middle, deviation)
        # Since the last step: points [m, D], their log densities and performance [m].
        self._episodes: list[dict[str, Tensor]] = []
        self._expected: float | None = None  # performance at the last step

    @classmethod
    def create(cls, run: Components, **settings: Any) -> SelfPacedCurriculum:
        """Makes it for a run's space, its target and the target's shares of the bins."""
        task = run.task
        return cls(task.space, task.target, task.target_shares, **settings)

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Draws points from the Gaussian, and returns the levels [n] there."""
        shape = count, self._points.size
        shares = torch.rand(shape, generator=rng.generator("choices"), dtype=torch.float64)
        points, log_density = draw_in_box(self.mean, self.deviation, shares)
        levels, bins = self._points.levels(points, rng)
        notes = {"bins": bins, "points": points, "log_density": log_density}
        return Batch(levels, TensorDict(notes, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Collects episodes, and moves the Gaussian when there are enough."""
        super().observe(student, batch, outcome)
        some = {name: batch.notes[name] for name in ("points", "log_density")}
        self._episodes.append({**some, "reached": outcome[self._measure].double().cpu()})
        if sum(len(some["reached"]) for some in self._episodes) >= self._every:
            self._step()

    def log(self) -> dict[str, Any]:
        """Returns counts of levels by bin, the Gaussian, and its divergence from the target."""
        if not bool(self._counts.any()):
            return {}
        return {
            "histogram": self.histogram(),
            "means": self.mean.tolist(),
            "deviations": self.deviation.tolist(),
            "target_divergence": divergence(self._now, self._target)[0],
            **({} if self._expected is None else {"expected_performance": self._expected}),
        }

    @property
    def _now(self) -> Gaussian:
        return Gaussian(self.mean.numpy(), self.deviation.numpy())

    def _step(self) -> None:
        """Moves the Gaussian by the episodes since the last step."""
        points, log_density, reached = (
            torch.cat([some[name] for some in self._episodes]).numpy()
            for name in ("points", "log_density", "reached")
        )
        found, self._expected = step_towards(
            self._target, self._now, points, log_density, reached, *self._limits
        )
        self.mean, self.deviation = map(torch.from_numpy, found)
        self._episodes = []


class Gaussian(NamedTuple):
    """A normal distribution with independent coordinates.

    Attributes:
        mean: float64 [D].
        deviation: standard deviations, float64 [D].
    """

    mean: Floats
    deviation: Floats


def draw_in_box(mean: Tensor, deviation: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Draws points of the box [-1, 1]^D from a Gaussian; returns them and their log densities.

    Args:
        mean: within the box, float64 [D].
        deviation: float64 [D].
        shares: uniform from 0 to 1, float64 [n, D].

    Returns:
        Points, float64 [n, D], and log densities up to a constant, float64 [n].
    """
    low, high = (torch.special.ndtr((end - mean) / deviation) for end in (-1.0, 1.0))
    z = torch.special.ndtri(low.lerp(high, shares))
    points = (mean + deviation * z).clamp(-1, 1)
    z = (points - mean) / deviation
    log_density = -z.square() / 2 - deviation.log() - (high - low).log()
    return points, log_density.sum(-1)


def divergence(one: Gaussian, other: Gaussian) -> tuple[float, Floats]:
    """Returns the Kullback-Leibler divergence KL(one, other) of Gaussians, and its gradient.

    Returns:
        The divergence; derivatives by the mean and by the logs of the deviations of one, [2 D].

    Example:
        >>> one, other = (Gaussian(np.array([mean]), np.ones(1)) for mean in (0.0, 1.0))
        >>> divergence(one, other)[0]
        0.5
    """
    ratio, away = one.deviation / other.deviation, (one.mean - other.mean) / other.deviation
    value = (ratio**2 + away**2 - 1).sum() / 2 - np.log(ratio).sum()
    return float(value), np.concatenate([away / other.deviation, ratio**2 - 1])


def expected_performance(
    one: Gaussian, points: Floats, log_density: Floats, reached: Floats
) -> tuple[float, Floats]:
    """Estimates the mean performance under a Gaussian from episodes, and its gradient.

    The weight of an episode is its density in this Gaussian over the density with which it was
    drawn; weights are normalised.

    Args:
        one: the Gaussian.
        points: of the episodes, [W, D].
        log_density: log density with which the points were drawn, up to a constant, [W].
        reached: results of the episodes, [W].

    Returns:
        The expectation; derivatives by the mean and by the logs of the deviations, [2 D].
    """
    z = (points - one.mean) / one.deviation
    log_weight = -(z**2).sum(-1) / 2 - np.log(one.deviation).sum() - log_density
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    value = float(weight @ reached)
    slopes = np.concatenate([z / one.deviation, z**2 - 1], -1)  # of the log densities
    return value, (weight * (reached - value)) @ slopes


def step_towards(
    target: Gaussian,
    now: Gaussian,
    points: Floats,
    log_density: Floats,
    reached: Floats,
    delta: float,
    epsilon: float,
    least: float,
) -> tuple[Gaussian, float]:
    """Returns the Gaussian nearest to the target that is in reach and performs well enough.

    Minimises KL(p, target) over Gaussians p with KL(p, now) <= epsilon and an expected performance
    of at least delta, by sequential quadratic programming (SciPy's SLSQP). If no Gaussian within
    epsilon performs that well, the result is the best performing one that is found.

    Args:
        target: the Gaussian to approach.
        now: the current Gaussian.
        points: of the episodes, [W, D].
        log_density: log density with which the points were drawn, up to a constant, [W].
        reached: results of the episodes, [W].
        delta: least expected performance.
        epsilon: largest divergence from the current Gaussian.
        least: smallest deviation of the new one.

    Returns:
        The new Gaussian, and its expected performance.
    """
    # SciPy's solvers take long to import, and no other curriculum needs them.
    from scipy.optimize import minimize

    size = len(now.mean)
    # In units of the current Gaussian, in which divergence from it is the same in all directions.
    units = np.concatenate([now.deviation, np.ones(size)])
    unit = float(reached.std()) or 1.0  # of performance

    def gaussian(x: Floats) -> Gaussian:
        return Gaussian(now.mean + now.deviation * x[:size], now.deviation * np.exp(x[size:]))

    def moved(x: Floats) -> tuple[float, Floats]:
        value, slope = divergence(gaussian(x), now)
        return epsilon - value, -slope * units

    def left(x: Floats) -> tuple[float, Floats]:
        """The log of the divergence, which goes over orders of magnitude."""
        value, slope = divergence(gaussian(x), target)
        return float(np.log(epsilon + value)), slope * units / (epsilon + value)

    def lacks(x: Floats) -> tuple[float, Floats]:
        value, slope = expected_performance(gaussian(x), points, log_density, reached)
        return (delta - value) / unit, -slope * units / unit

    def reaches(x: Floats) -> tuple[float, Floats]:
        value, slope = lacks(x)
        return -value, -slope

    def least_of(goal: Goal, start: Floats, *held: Goal) -> Floats:
        """Minimises a goal while others are not negative; returns the start if that fails."""
        found = minimize(
            goal,
            start,
            jac=True,
            method="SLSQP",
            bounds=list(zip(lowest, highest, strict=True)),
            constraints=[
                {"type": "ineq", "fun": lambda x, f=f: f(x)[0], "jac": lambda x, f=f: f(x)[1]}
                for f in held
            ],
            options={"maxiter": 200, "ftol": 1e-9},
        ).x.clip(lowest, highest)
        kept = all(each(found)[0] >= -SLACK for each in held)
        return found if kept and goal(found)[0] < goal(start)[0] else start

    # Bounds of the mean, which stays in the box, and of the deviations.
    lowest = np.concatenate([(-1 - now.mean) / now.deviation, np.log(least / now.deviation)])
    highest = np.concatenate([(1 - now.mean) / now.deviation, np.log(WIDEST / now.deviation)])
    x = np.zeros(2 * size)
    if lacks(x)[0] > 0:
        x = least_of(lacks, x, moved)
    if lacks(x)[0] <= 0:
        x = least_of(left, x, moved, reaches)
    return gaussian(x), delta - lacks(x)[0] * unit
