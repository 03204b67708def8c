"""How often intervals cover and verdicts are wrong, by simulation with 5 and 10 seeds.

A share of 2,000 replications has a standard error of 0.005: what is asked for is 0.93.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from proposer_rl.report.statistics import (
    Interval,
    difference_of,
    mean_of,
)

REPLICATIONS, ENOUGH = 2000, 0.93
Law = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]

pytestmark = pytest.mark.slow

LAWS: dict[str, Law] = {
    "normal": lambda rng, shape: rng.normal(0.5, 0.1, shape),
    "skewed": lambda rng, shape: rng.beta(2, 5, shape),
    "skewed to the left": lambda rng, shape: rng.beta(5, 2, shape),
    "a third cut off": lambda rng, shape: np.minimum(rng.lognormal(0, 0.5, shape), 1.24),
    "half cut off": lambda rng, shape: np.minimum(rng.lognormal(0, 0.5, shape), 1.0),
    "most cut off": lambda rng, shape: np.minimum(rng.lognormal(0, 0.5, shape), 0.66),
}


def covered(intervals: Sequence[Interval], truth: float) -> float:
    """Share of the intervals, of those that there are, that hold the truth."""
    known = np.array([one for one in intervals if not np.isnan(one.low)])
    assert len(known) > REPLICATIONS / 2
    return float(np.mean((known[:, 1] <= truth) & (truth <= known[:, 2])))


def mean_under(law: Law) -> float:
    return float(law(np.random.default_rng(1), (10**6,)).mean())


@pytest.mark.parametrize("seeds", [5, 10])
@pytest.mark.parametrize("name", LAWS)
def test_intervals_of_means_cover(name: str, seeds: int) -> None:
    """Those that verdicts rest on."""
    drawn = LAWS[name](np.random.default_rng(0), (REPLICATIONS, seeds))
    found = [mean_of(row).interval() for row in drawn]
    assert covered(found, mean_under(LAWS[name])) >= ENOUGH


@pytest.mark.parametrize("seeds", [5, 10])
@pytest.mark.parametrize("paired", [False, True])
@pytest.mark.parametrize("name", LAWS)
def test_intervals_of_differences_cover(name: str, paired: bool, seeds: int) -> None:
    """Against the same law, and against one that varies less."""
    rng, law = np.random.default_rng(0), LAWS[name]
    one, same = (law(rng, (REPLICATIONS, seeds)) for _ in range(2))
    steady = rng.normal(0.5, 0.3 if "cut" in name else 0.1, (REPLICATIONS, seeds))
    for other, truth in ((same, 0.0), (steady, mean_under(law) - 0.5)):
        found = [difference_of(a, b, paired).interval() for a, b in zip(one, other, strict=True)]
        assert covered(found, truth) >= ENOUGH
