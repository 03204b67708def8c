"""Computes medians, differences and shares over few runs, with intervals that hold for five.

Nothing here knows what a run is. ``tests/report/test_coverage.py`` and ``bin/research intervals``
measure how often the intervals cover, and how often equal distributions differ significantly.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # loads its functions when they are used; drawing a run uses none
from numpy.typing import NDArray

CONFIDENCE = 0.95
ERROR = 1 - CONFIDENCE  # how often a test may be wrong
HELD = 0.93  # how often at least an interval of a median holds it; five runs give 0.9375
MOST_SEEDS = 1_000_000  # needing more means that there is no difference
FEWEST = 5  # runs for an interval
POWER = 0.8

# Explains a method's numbers to a reader.
INTERVALS = (
    "Numbers are medians over seeds, and costs are means. Brackets contain the median of such runs "
    f"with a probability of at least {HELD:.0%}, for any distribution; they need {FEWEST} seeds, "
    "and are not corrected for the number of methods."
)

Values = Sequence[float] | NDArray[np.float64]


class Interval(NamedTuple):
    """An estimate with its confidence interval; NaN bounds where there is too little data."""

    estimate: float
    low: float
    high: float


class Estimate(NamedTuple):
    """A mean, or a difference of means, with its error by Student's distribution.

    Attributes:
        value: the estimate.
        error: its standard error; NaN with fewer than :data:`FEWEST` runs, or without any spread.
        freedom: degrees of freedom.
    """

    value: float
    error: float
    freedom: float

    def interval(self, confidence: float = CONFIDENCE) -> Interval:
        """Returns Student's confidence interval."""
        half = self.error * float(scipy.special.stdtrit(self.freedom, (1 + confidence) / 2))
        return Interval(self.value, self.value - half, self.value + half)

    @property
    def p(self) -> float:
        """Two-sided p-value against zero."""
        return float(2 * scipy.special.stdtr(self.freedom, -abs(self.value) / self.error))


def mean_of(values: Values) -> Estimate:
    """Returns the mean of independent values, with its standard error and degrees of freedom.

    The degrees of freedom are n minus the number of runs that share the most common value: n - 1
    where all differ, and fewer where runs are cut off at a horizon, since only the others show the
    spread. With n - 1 there the interval covers 88 % instead of 95 % (five runs, half cut off).
    """
    array = np.asarray(values, dtype=float)
    count, (_, alike) = len(array), np.unique(array, return_counts=True)
    known = count >= FEWEST and len(alike) > 1
    error = float(array.std(ddof=1)) / math.sqrt(count) if known else math.nan
    return Estimate(float(array.mean()), error, float(max(count - alike.max(), 1)))


def difference_of(one: Values, other: Values, paired: bool = False) -> Estimate:
    """Returns the difference of two means, ``one`` minus ``other``.

    Args:
        one: independent values.
        other: others; where paired the i-th belongs to the i-th of ``one``.
        paired: by Student's t of the differences, else by Welch's (Biometrika 34, 1947).
    """
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    if paired:
        return mean_of(a - b)
    value = float(a.mean() - b.mean())
    if min(len(a), len(b)) < FEWEST or np.ptp(a) == np.ptp(b) == 0:
        return Estimate(value, math.nan, 1.0)
    return _of_sum(value, [x.var(ddof=1) / len(x) for x in (a, b)], [len(a) - 1, len(b) - 1])


def mean_of_estimates(found: Sequence[Estimate]) -> Estimate:
    """Returns the unweighted mean of independent estimates.

    Its error is NaN where one of theirs is unknown, or all are 0.
    """
    value = float(np.mean([one.value for one in found]))
    squares = [one.error**2 for one in found]
    if not sum(squares) > 0:
        return Estimate(value, math.nan, 1.0)
    of_sum = _of_sum(value, squares, [one.freedom for one in found])
    return of_sum._replace(error=of_sum.error / len(found))


def balanced(one: Values, other: Values) -> Estimate:
    """Returns Welch's difference as if both had as many values as the fewer."""
    a, b = (np.asarray(values, dtype=float) for values in (one, other))
    count = min(len(a), len(b))
    squares = [x.var(ddof=1) / count for x in (a, b)]
    return _of_sum(float(a.mean() - b.mean()), squares, [count - 1] * 2)


def _of_sum(value: float, squares: Sequence[float], freedoms: Sequence[float]) -> Estimate:
    """Returns an estimate whose squared error is the sum of independent ones.

    Its degrees of freedom are Satterthwaite's (Biometrics Bulletin 2, 1946).
    """
    whole = float(sum(squares))
    parts = [square**2 / freedom for square, freedom in zip(squares, freedoms, strict=True)]
    return Estimate(value, math.sqrt(whole), whole**2 / float(sum(parts)))


def median_of(values: Values) -> tuple[Any, Any, Any]:
    """Returns the median of independent values, with an interval that holds for any distribution.

    The interval goes from the k-th lowest value to the k-th highest, with the largest k for which
    it contains the median of the distribution with a probability of at least :data:`HELD`: each
    value is below that median with a probability of at most one half (Thompson, Annals of
    Mathematical Statistics 7, 1936). Of five values it is the lowest and the highest, of ten the
    second of either side. No such interval exists for a mean: see ``results/intervals.md``.

    Args:
        values: float [n, ...], independent along the first axis; a value may be missing (NaN).

    Returns:
        Median, lower and upper end, each [...]; ends are NaN for fewer than :data:`FEWEST` values,
        or where one is missing.
    """
    rows = np.sort(np.asarray(values, dtype=float), 0)  # what is missing comes last
    known = np.isfinite(rows).sum(0)
    middle = np.take_along_axis(rows, np.stack([(known - 1) // 2, known // 2]).clip(0), 0).mean(0)
    rank = int(scipy.stats.binom.ppf((1 - HELD) / 2, len(rows), 0.5))
    low, high = rows[[rank - 1, -rank]]
    whole = (known == len(rows)) & (rank > 0)
    return middle, np.where(whole, low, math.nan), np.where(whole, high, math.nan)


def median_interval(values: Values) -> Interval:
    """Returns the median of independent values with its interval: see :func:`median_of`."""
    return Interval(*map(float, median_of(values)))


def holm(p_values: Sequence[float]) -> list[float]:
    """Returns p-values corrected for their number (Holm, Scandinavian J. of Statistics 6, 1979).

    Calling them significant at 5 % is wrong about any of them in at most 5 % of the cases. NaN
    stands for what could not be tested; it stays and does not count.
    """
    p = np.asarray(p_values, dtype=float)
    order = np.argsort(p)[: int(np.isfinite(p).sum())]  # NaN comes last
    corrected = np.full(len(p), math.nan)
    steps = p[order] * np.arange(len(order), 0, -1)
    corrected[order] = np.maximum.accumulate(steps).clip(max=1.0)
    return corrected.tolist()


def seeds_needed(difference: Estimate, seeds: int, level: float) -> int | None:
    """Returns about how many seeds would show a difference as large as the one seen.

    The power is 80 %. The two quantiles of Student's distribution, of the test and of the power,
    add up to the difference in standard errors, which fall with the root of the number of seeds
    (Cohen, Statistical Power Analysis, 1988).

    Args:
        difference: as it was seen.
        seeds: with so many of each.
        level: of the two-sided test.

    Returns:
        None with too few seeds, or without any difference.
    """
    effect = abs(difference.value) / difference.error
    if not effect > 0:
        return None

    def enough(count: int) -> bool:
        freedom = difference.freedom * count / seeds
        quantiles = scipy.special.stdtrit(freedom, [1 - level / 2, POWER])
        return bool(quantiles.sum() <= effect * math.sqrt(count / seeds))

    quantiles = scipy.special.ndtri([1 - level / 2, POWER])
    least = math.floor(seeds * (float(quantiles.sum()) / effect) ** 2)  # of a normal distribution
    if least > MOST_SEEDS:
        return None
    return next(count for count in itertools.count(max(least, seeds + 1)) if enough(count))
