"""Statistics against closed forms, exact enumeration and SciPy."""

from __future__ import annotations

import itertools
import math
import statistics

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from proposer_rl.report.statistics import (
    FEWEST,
    HELD,
    balanced,
    difference_of,
    holm,
    mean_of,
    median_interval,
    median_of,
    seeds_needed,
)

values = st.lists(st.floats(-1, 1, width=16), min_size=FEWEST, max_size=8)


def test_intervals_of_means_are_students() -> None:
    # Variance 12.5, n = 5; tables of Student's t have 2.776445 for 4 degrees of freedom at 97.5 %.
    half = 2.776445 * math.sqrt(12.5 / 5)
    found = mean_of([1, 2, 3, 4, 10]).interval()
    assert found == pytest.approx((4, 4 - half, 4 + half), abs=1e-5)


@given(st.lists(st.floats(-1, 1), min_size=5, max_size=40))
def test_intervals_of_medians_are_scipys(found: list[float]) -> None:
    """Of its test of a quantile; and no narrower one of two values holds the median as often."""
    one = median_interval(found)
    assert one.estimate == statistics.median(found)
    known = stats.quantile_test(found, p=0.5).confidence_interval(HELD)
    assert one[1:] == (known.low, known.high)


def test_what_is_missing_leaves_a_median_without_an_interval() -> None:
    rows = np.array([[3.0, 1.0, 2.0, 5.0, 4.0], [1.0, math.nan, 3.0, 5.0, 7.0], [math.nan] * 5]).T
    median, low, high = median_of(rows)
    assert median == pytest.approx([3, 4, math.nan], nan_ok=True)
    assert low == pytest.approx([1, math.nan, math.nan], nan_ok=True)
    assert high == pytest.approx([5, math.nan, math.nan], nan_ok=True)


def test_runs_that_were_cut_off_tell_nothing_of_the_spread() -> None:
    cut = mean_of([100, 120, 200, 200, 200])
    assert cut.freedom == 2 and mean_of([1, 2, 3, 4, 5]).freedom == 4
    half = 4.302653 * np.std([100, 120, 200, 200, 200], ddof=1) / math.sqrt(5)  # of the tables
    assert cut.interval()[1:] == pytest.approx((164 - half, 164 + half), abs=1e-4)


@given(values, values)
def test_differences_are_those_of_scipy(one: list[float], other: list[float]) -> None:
    if np.ptp(one) > 1e-3 and np.ptp(other) > 1e-3:
        found, known = difference_of(one, other), stats.ttest_ind(one, other, equal_var=False)
        assert found.interval()[1:] == pytest.approx(tuple(known.confidence_interval()), abs=1e-9)
        assert found.p == pytest.approx(known.pvalue, abs=1e-9)


def test_pairs_are_compared_by_their_differences() -> None:
    one, other = np.array([1.0, 2.5, 3.0, 4.0, 7.0]), np.array([0.5, 2.25, 2.0, 3.9, 4.0])
    found, known = difference_of(one, other, paired=True), stats.ttest_rel(one, other)
    assert found.p == pytest.approx(known.pvalue)
    assert found.interval()[1:] == pytest.approx(tuple(known.confidence_interval()))


def test_too_few_runs_and_runs_without_spread_have_no_interval() -> None:
    for few in ([1.0], [1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [2.0] * 9):
        assert math.isnan(mean_of(few).interval().low) and math.isnan(mean_of(few).p)
        assert math.isnan(median_interval(few).low) == (len(few) < FEWEST)
    many = [1.0, 2.0, 3.0, 4.0, 5.0]
    assert math.isnan(difference_of([1.0, 3.0], many).p)
    assert math.isnan(difference_of([1.0] * 5, [2.0] * 5).p)
    assert seeds_needed(mean_of([1.0, 2.0]), 2, 0.05) is None


small = st.lists(st.integers(0, 5), min_size=FEWEST, max_size=8)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=6))
def test_holms_method_is_the_closed_one(p_values: list[float]) -> None:
    """One falls where every set with it falls by Bonferroni's test (Marcus et al., 1976)."""
    count = len(p_values)
    closed = []
    for i in range(count):
        sets = [
            chosen
            for size in range(1, count + 1)
            for chosen in itertools.combinations(range(count), size)
            if i in chosen
        ]
        closed.append(max(min(1.0, len(s) * min(p_values[j] for j in s)) for s in sets))
    assert holm(p_values) == pytest.approx(closed)


def test_what_was_not_tested_does_not_count() -> None:
    first, none, second = holm([0.01, math.nan, 0.04])
    assert (first, second) == (0.02, 0.04) and math.isnan(none)
    assert holm([]) == []


def test_no_number_of_seeds_finds_a_difference_of_rounding() -> None:
    one = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    assert (
        seeds_needed(difference_of(one, one + 1e-17 * np.arange(5) + 2e-17, False), 5, 0.05) is None
    )


@pytest.mark.parametrize("paired", [False, True])
def test_seeds_needed_have_the_power_in_a_simulation(paired: bool) -> None:
    rng = np.random.default_rng(0)
    one, other = np.array([0.0, 1.0, 2.0, 1.5, 0.5]), np.array([1.0, 0.5, 2.75, 1.5, 1.25])
    count = seeds_needed(difference_of(one, other, paired), 5, 0.01)
    assert count is not None and count > 5
    covariance = np.cov(one, other) if paired else np.diag([one.var(ddof=1), other.var(ddof=1)])
    drawn = rng.multivariate_normal([one.mean(), other.mean()], covariance, (4000, count))
    test = stats.ttest_rel if paired else stats.ttest_ind
    p_values = test(drawn[..., 0], drawn[..., 1], axis=1).pvalue
    assert np.mean(p_values < 0.01) == pytest.approx(0.8, abs=0.05)
    # Twice the runs of one of them, with the same mean and variance, say the same of each.
    more = np.concatenate([one, one]) * math.sqrt(9 / 8)
    more += one.mean() - more.mean()
    if not paired:
        assert balanced(more, other) == pytest.approx(difference_of(one, other))
