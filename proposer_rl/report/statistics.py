"""Comparisons of groups of runs, of which some never reached the threshold.

A run that did not reach it within its length is *censored*: all that is known is that it needs more
updates. Leaving such runs out, or taking their length for the answer, would flatter the method that
fails most. What can be estimated without bias is the restricted mean: the mean of min(T, horizon),
the area under the Kaplan-Meier curve up to the horizon (Royston & Parmar, BMC Medical Research
Methodology 13:152, 2013). All estimators are SciPy's; nothing here knows what a run is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 2000
QUARTER = 0.25
MANY = 1000  # runs in a group
CERTAIN = 20.0  # standard deviations between two means

Values = Sequence[float] | NDArray[np.float64]


class Waiting(NamedTuple):
    """Updates until a threshold, of one run.

    Attributes:
        updates: when it was reached or, for a censored run, how long the run was.
        reached: whether it was; False for a censored run.
    """

    updates: float
    reached: bool


class Interval(NamedTuple):
    """An estimate with its confidence interval; NaN bounds where there is too little data."""

    estimate: float
    low: float
    high: float

    @property
    def decided(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0 or self.high < 0


def mean_interval(values: Values) -> Interval:
    """Mean of independent values with Student's interval, as in the curves over seeds."""
    array = np.asarray(values, dtype=float)
    mean = float(array.mean())
    if len(array) < 2:
        return Interval(mean, math.nan, math.nan)
    half = float(stats.sem(array) * stats.t.ppf((1 + CONFIDENCE) / 2, len(array) - 1))
    return Interval(mean, mean - half, mean + half)


def interquartile_mean(values: Values) -> float:
    """Mean without the lowest and the highest quarter (Agarwal et al., NeurIPS 2021)."""
    return float(stats.trim_mean(np.asarray(values, dtype=float), QUARTER))


def common_horizon(groups: Sequence[Sequence[Waiting]]) -> float:
    """The largest horizon up to which every group's Kaplan-Meier curve is known.

    A group's curve is known up to its longest censored run, and everywhere if some run reached the
    threshold after that; where all curves are, the latest of these times is the horizon.
    """
    known = [_known_until(group) for group in groups]
    latest = max(run.updates for group in groups for run in group)
    return min([*known, latest])


def _known_until(group: Sequence[Waiting]) -> float:
    censored = max((run.updates for run in group if not run.reached), default=-math.inf)
    reached = max((run.updates for run in group if run.reached), default=-math.inf)
    return math.inf if reached > censored else censored


def restricted_mean(group: Sequence[Waiting], horizon: float) -> float:
    """Mean of min(updates, horizon): the area under the Kaplan-Meier curve up to the horizon.

    Args:
        group: independent runs, at least one.
        horizon: not beyond :func:`common_horizon`.
    """
    survival = stats.ecdf(_censored(group, horizon)).sf
    inside = survival.quantiles[survival.quantiles < horizon]
    steps = np.concatenate([[0.0], inside, [horizon]])
    alive = np.concatenate([[1.0], survival.probabilities[: len(inside)]])
    return float(np.sum(np.diff(steps) * alive))


def restricted_interval(group: Sequence[Waiting], horizon: float) -> Interval:
    """Restricted mean of a group, with a percentile bootstrap over its runs."""
    return _percentiles(restricted_mean(group, horizon), _resampled(tuple(group), horizon, 0))


def restricted_difference(
    one: Sequence[Waiting], other: Sequence[Waiting], horizon: float
) -> Interval:
    """Restricted mean of one group minus another's; negative where ``one`` is faster.

    The interval is a percentile bootstrap over the runs of each group: unlike BCa it is defined
    where runs tie, as those that are censored at the horizon do.
    """
    estimate = restricted_mean(one, horizon) - restricted_mean(other, horizon)
    # Two streams: the groups are drawn independently of each other.
    replicates = _resampled(tuple(one), horizon, 0) - _resampled(tuple(other), horizon, 1)
    return _percentiles(estimate, replicates)


def mean_difference(one: Values, other: Values) -> Interval:
    """Difference of two means with Welch's interval."""
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    estimate = float(a.mean() - b.mean())
    if min(len(a), len(b)) < 2 or not (a.std() or b.std()):
        return Interval(estimate, math.nan, math.nan)
    interval = stats.ttest_ind(a, b, equal_var=False).confidence_interval(CONFIDENCE)
    return Interval(estimate, float(interval.low), float(interval.high))


def probability_of_improvement(one: Values, other: Values) -> Interval:
    """How probable it is that a run of ``one`` has a greater value than a run of ``other``.

    P(X > Y) + P(X = Y) / 2 over all pairs: the Mann-Whitney statistic over the number of pairs
    (Agarwal et al., NeurIPS 2021), with a percentile bootstrap over the runs of each group.
    """

    def share(a: Any, b: Any, axis: int = -1) -> Any:
        pairs = a.shape[axis] * b.shape[axis]
        return stats.mannwhitneyu(a, b, axis=axis, method="asymptotic").statistic / pairs

    data = [np.asarray(values, dtype=float) for values in (one, other)]
    replicates = np.full(1, math.nan)
    if min(map(len, data)) > 1:
        replicates = _bootstrap(data, share, 0, vectorized=True)
    found = _percentiles(float(share(data[0], data[1])), replicates)
    return Interval(*(float(np.clip(value, 0, 1)) for value in found))


def pseudo_values(group: Sequence[Waiting], horizon: float) -> NDArray[np.float64]:
    """Each run's part in the restricted mean, also of those whose min(T, horizon) is unknown.

    Jackknife pseudo-observations n θ - (n - 1) θ without run i (Andersen, Hansen & Klein, Lifetime
    Data Analysis 10, 2004). Where every run was followed up to the horizon they are min(T, horizon)
    exactly.
    """
    count, runs = len(group), list(group)
    if count == 1:
        return np.array([restricted_mean(runs, horizon)])
    whole = restricted_mean(runs, horizon)
    without = [restricted_mean(runs[:i] + runs[i + 1 :], horizon) for i in range(count)]
    return count * whole - (count - 1) * np.array(without)


def seeds_needed(one: Values, other: Values, power: float = 0.8) -> int | None:
    """Seeds per group with which a difference as large as the one seen would be found.

    Found means: by the two-sided t test at 5 %, with the given power; from the noncentral F
    distribution (Cohen, Statistical Power Analysis, 1988, chapter 2).

    Returns:
        None where nothing can be said: a group of one run, or no difference at all.
    """
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    if min(len(a), len(b)) < 2:
        return None
    spread = math.sqrt((a.var(ddof=1) + b.var(ddof=1)) / 2)
    difference = abs(float(a.mean() - b.mean()))
    if difference == 0:
        return None
    effect = difference / spread if spread else math.inf
    quantiles = stats.norm.ppf([(1 + CONFIDENCE) / 2, power])
    normal = 2 * (float(quantiles.sum()) / effect) ** 2
    if normal > MANY:
        return math.ceil(normal)  # t and normal distributions are alike there
    counts = range(2, math.ceil(normal) + 4)
    return next(count for count in counts if _power(count, effect) >= power)


def _power(count: int, effect: float) -> float:
    """Power of the two-sided t test with ``count`` runs in each group: of F, which is t squared."""
    if effect > CERTAIN:
        return 1.0
    freedom = 2 * count - 2
    critical = stats.f.ppf(CONFIDENCE, 1, freedom)
    return float(stats.ncf.sf(critical, 1, freedom, count / 2 * effect**2))


def _censored(group: Sequence[Waiting], horizon: float) -> stats.CensoredData:
    """Runs as known at the horizon: whatever happens later has not happened yet."""
    events = [run.updates for run in group if run.reached and run.updates <= horizon]
    censored = [
        min(run.updates, horizon) for run in group if not run.reached or run.updates > horizon
    ]
    return stats.CensoredData(uncensored=events, right=censored)


@lru_cache(maxsize=256)
def _resampled(group: tuple[Waiting, ...], horizon: float, stream: int) -> NDArray[np.float64]:
    """Restricted means of resamples of a group's runs; NaN for a group of one."""
    if len(group) < 2:
        return np.full(1, math.nan)
    known: dict[tuple[int, ...], float] = {}  # resamples of the same runs, of which there are many

    def of_indices(indices: NDArray[np.int64]) -> float:
        drawn = tuple(sorted(int(i) for i in indices))
        if drawn not in known:
            known[drawn] = restricted_mean([group[i] for i in drawn], horizon)
        return known[drawn]

    return _bootstrap([np.arange(len(group))], of_indices, stream, vectorized=False)


def _bootstrap(
    data: Sequence[NDArray[Any]], statistic: Callable[..., Any], stream: int, *, vectorized: bool
) -> NDArray[np.float64]:
    result = stats.bootstrap(
        data,
        statistic,
        vectorized=vectorized,
        method="percentile",
        n_resamples=RESAMPLES,
        rng=np.random.default_rng(stream),  # the same runs always get the same interval
    )
    return np.asarray(result.bootstrap_distribution, dtype=float)


def _percentiles(estimate: float, replicates: NDArray[np.float64]) -> Interval:
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(replicates, [tail, 1 - tail])
    return Interval(estimate, float(low), float(high))
