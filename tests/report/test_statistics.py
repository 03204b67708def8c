"""Statistics against closed forms, exact enumeration and simulation."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from proposer_rl.report.statistics import (
    Waiting,
    common_horizon,
    interquartile_mean,
    mean_difference,
    mean_interval,
    probability_of_improvement,
    pseudo_values,
    restricted_difference,
    restricted_interval,
    restricted_mean,
    seeds_needed,
)

runs = st.builds(Waiting, st.integers(1, 20).map(float), st.booleans())
groups = st.lists(runs, min_size=1, max_size=8)


def product_limit_area(group: list[Waiting], horizon: int) -> Fraction:
    """Area under the product-limit estimate, one unit of time after another, in exact numbers."""
    alive, area = Fraction(1), Fraction(0)
    for time in range(horizon):
        at_risk = sum(run.updates >= time for run in group)
        events = sum(run.reached and run.updates == time for run in group)
        if events:
            alive *= 1 - Fraction(events, at_risk)
        area += alive
    return area


@given(groups, st.integers(1, 20))
def test_the_restricted_mean_is_the_product_limit_area(group: list[Waiting], horizon: int) -> None:
    horizon = min(horizon, int(common_horizon([group])))
    expected = float(product_limit_area(group, horizon))
    assert restricted_mean(group, horizon) == pytest.approx(expected)


@given(st.lists(st.integers(1, 20).map(float), min_size=1, max_size=8), st.integers(1, 20))
def test_of_runs_followed_to_the_horizon_it_is_a_plain_mean(
    times: list[float], horizon: int
) -> None:
    group = [Waiting(time, True) if time <= horizon else Waiting(horizon, False) for time in times]
    cut = [min(time, horizon) for time in times]
    assert restricted_mean(group, horizon) == pytest.approx(np.mean(cut))
    assert pseudo_values(group, horizon) == pytest.approx(cut)


@given(groups)
def test_what_happens_after_the_horizon_does_not_count(group: list[Waiting]) -> None:
    horizon = common_horizon([group]) / 2
    later = [Waiting(run.updates + 5, True) if run.updates > horizon else run for run in group]
    assert restricted_mean(later, horizon) == pytest.approx(restricted_mean(group, horizon))


def test_the_horizon_is_where_the_first_curve_ends() -> None:
    fast = [Waiting(10, True), Waiting(30, True)]
    stopped = [Waiting(20, True), Waiting(50, False)]
    late = [Waiting(70, True), Waiting(40, False)]
    assert common_horizon([fast]) == 30
    assert common_horizon([fast, stopped]) == 50
    assert common_horizon([fast, late]) == 70
    assert common_horizon([fast, stopped, late]) == 50


def exact_percentiles(values: list[float], statistic) -> tuple[float, float]:
    """Ends of the percentile interval over all n**n resamples."""
    every = [statistic(drawn) for drawn in itertools.product(values, repeat=len(values))]
    low, high = np.quantile(every, [0.025, 0.975], method="inverted_cdf")
    return float(low), float(high)


def test_the_bootstrap_is_that_over_all_resamples() -> None:
    group = [Waiting(float(t), True) for t in (10, 20, 40, 80)] + [Waiting(100, False)]
    times = [10.0, 20.0, 40.0, 80.0, 100.0]
    interval = restricted_interval(group, 100)
    low, high = exact_percentiles(times, np.mean)
    assert interval.estimate == pytest.approx(50)
    # Two neighbouring resamples differ by 2 to 4 updates.
    assert interval.low == pytest.approx(low, abs=4) and interval.high == pytest.approx(high, abs=4)


def test_the_difference_is_that_of_independent_resamples() -> None:
    one, other = np.array([10.0, 20.0, 40.0, 80.0]), np.array([30.0, 90.0, 100.0, 100.0])
    groups = [[Waiting(t, t < 100) for t in times] for times in (one, other)]
    means = [np.array(list(itertools.product(times, repeat=4))).mean(1) for times in (one, other)]
    low, high = np.quantile(np.subtract.outer(*means), [0.025, 0.975])
    interval = restricted_difference(*groups, horizon=100)
    assert interval.estimate == pytest.approx(one.mean() - other.mean())
    # Differences are multiples of 2.5: the ends of 2,000 resamples are at most one step off.
    assert interval.low == pytest.approx(low, abs=2.6) and interval.high == pytest.approx(
        high, abs=2.6
    )
    turned = restricted_difference(*groups[::-1], 100)
    assert interval.estimate == pytest.approx(-turned.estimate)


def test_groups_are_resampled_independently() -> None:
    group = [Waiting(float(t), True) for t in (10, 20, 40, 80)]
    interval = restricted_difference(group, list(group), 100)
    assert interval.estimate == 0 and interval.low < -20 and interval.high > 20
    assert not interval.decided


def test_runs_that_all_failed_are_equal_and_nothing_is_decided() -> None:
    failed = [Waiting(200, False)] * 5
    assert restricted_difference(failed, failed, 200) == (0, 0, 0)
    reached = [Waiting(100, True)] * 5
    assert restricted_difference(reached, failed, 200) == (-100, -100, -100)
    assert restricted_difference(reached, failed, 200).decided


def test_one_run_has_no_interval() -> None:
    one, two = [Waiting(5, True)], [Waiting(7, True), Waiting(9, True)]
    difference = restricted_difference(one, two, 10)
    assert difference.estimate == -3 and math.isnan(difference.low) and not difference.decided
    assert math.isnan(probability_of_improvement([1.0], [2.0, 3.0]).low)
    assert math.isnan(mean_interval([1.0]).low)
    assert seeds_needed([1.0], [2.0, 3.0]) is None


@settings(max_examples=20)
@given(
    st.lists(st.integers(0, 5), min_size=2, max_size=6),
    st.lists(st.integers(0, 5), min_size=2, max_size=6),
)
def test_improvement_counts_pairs_and_half_of_ties(one: list[int], other: list[int]) -> None:
    wins = sum((a > b) + (a == b) / 2 for a in one for b in other)
    found = probability_of_improvement(one, other)
    assert found.estimate == pytest.approx(wins / len(one) / len(other))
    assert 0 <= found.low <= found.high <= 1


def test_the_interquartile_mean_leaves_a_quarter_out_at_each_end() -> None:
    assert interquartile_mean([0, 1, 2, 3, 4, 5, 6, 1000]) == pytest.approx((2 + 3 + 4 + 5) / 4)


def test_intervals_of_means_are_students_and_welchs() -> None:
    # Variance 12.5, n = 5; tables of Student's t have 2.776445 for 4 degrees of freedom at 97.5 %.
    half = 2.776445 * math.sqrt(12.5 / 5)
    assert mean_interval([1, 2, 3, 4, 10]) == pytest.approx((4, 4 - half, 4 + half), abs=1e-5)
    # By hand: variances 1 and 4, n = 3, standard error sqrt(5/3), Welch's degrees of freedom 50/17.
    difference = mean_difference([1, 2, 3], [2, 4, 6])
    half = stats.t.ppf(0.975, 50 / 17) * math.sqrt(5 / 3)
    assert difference == pytest.approx((-2, -2 - half, -2 + half))


def test_seeds_needed_are_those_of_cohens_tables() -> None:
    # Cohen (1988), two-sided 5 %, power 0.80: 26 per group for d = 0.8, 64 for 0.5, 393 for 0.2.
    spread = np.array([-1.0, 1.0]) / math.sqrt(2)  # standard deviation 1
    for effect, expected in ((0.8, 26), (0.5, 64)):
        assert seeds_needed(spread + effect, spread) == expected
    assert seeds_needed(spread + 0.2, spread) in (393, 394)  # Cohen rounds the table's entry
    assert seeds_needed(spread, spread) is None
    assert seeds_needed([1.0, 1.0], [2.0, 2.0]) == 2


@given(st.floats(-8, 3))
def test_seeds_needed_are_found_for_every_effect(exponent: float) -> None:
    effect = 10**exponent
    spread = np.array([-1.0, 1.0]) / math.sqrt(2)
    count = seeds_needed(spread + effect, spread)
    # The normal distribution's answer is a lower bound, and close to it for many.
    normal = 2 * (sum(stats.norm.ppf([0.975, 0.8])) / effect) ** 2
    assert count is not None and max(2, normal * 0.999) <= count <= 1.001 * normal + 4


def test_seeds_needed_have_the_power_in_a_simulation() -> None:
    rng = np.random.default_rng(0)
    one, other = [0.0, 1.0, 2.0], [1.0, 2.5, 4.0]
    count = seeds_needed(one, other)
    assert count is not None
    draw_one = stats.norm(np.mean(one), np.std(one, ddof=1))
    draw_other = stats.norm(np.mean(other), np.std(other, ddof=1))
    p_values = stats.ttest_ind(
        draw_one.rvs((4000, count), random_state=rng),
        draw_other.rvs((4000, count), random_state=rng),
        axis=1,
    ).pvalue
    assert np.mean(p_values < 0.05) == pytest.approx(0.82, abs=0.03)


values = st.lists(st.floats(-1, 1, width=16), min_size=2, max_size=5)


@settings(max_examples=20)
@given(values, values)
def test_a_probability_is_within_its_bounds(one: list[float], other: list[float]) -> None:
    for estimate in (
        probability_of_improvement(one, other),
        probability_of_improvement(other, one),
    ):
        assert all(0 <= value <= 1 for value in estimate)
