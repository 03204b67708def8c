"""Parameters on a logarithmic scale, against NumPy's and SciPy's."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import scipy
import torch
from hypothesis import given
from hypothesis import strategies as st

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from proposer_rl.tasks.ranges import RangeSettings, spaces

RANGES = st.tuples(st.floats(1e-6, 1e3), st.floats(1.01, 1e6)).map(lambda p: (p[0], p[0] * p[1]))


def space(low: float, high: float, bins: int = 1, **more: Any) -> prl.Parameters:
    return prl.Parameters({"x": prl.Log(low, high)}, bins=bins, **more)


@given(RANGES, st.integers(1, 20))
def test_bins_are_equal_in_ratio_and_stand_for_their_geometric_means(
    ends: tuple[float, float], count: int
) -> None:
    line = space(*ends, count)
    edges = np.geomspace(*ends, count + 1)
    part = line.bins["x"]
    assert np.allclose(part.low, edges[:-1], rtol=1e-12, atol=0)
    assert np.allclose(part.high, edges[1:], rtol=1e-12, atol=0)
    middles = [math.sqrt(low * high) for low, high in pairwise(edges)]
    assert line.axes["x"] == pytest.approx(middles, rel=1e-9)
    if count > 1:  # evenly spaced, from -1 to 1
        assert line.coordinates[:, 0].tolist() == pytest.approx(np.linspace(-1, 1, count), abs=1e-5)


@pytest.mark.parametrize("target", [None, (0.01, 0.03)])
def test_draws_are_log_uniform(target: Any) -> None:
    line = space(0.01, 1.0, 4, target={"x": target} if target else None)
    drawn = (line.target if target else line).sample(4000, Streams(0).generator())["x"]
    law = scipy.stats.loguniform(*(target or (0.01, 1.0)))
    assert scipy.stats.kstest(drawn.numpy(), law.cdf).pvalue > 0.01
    bins = line.generate(torch.full((1, 4000), 2), [Streams(0).generator()])[0]["x"]
    assert scipy.stats.kstest(bins.numpy(), scipy.stats.loguniform(0.1, 10**-0.5).cdf).pvalue > 0.01


@given(RANGES, st.integers(1, 6), st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_a_target_lies_in_the_bins_as_its_log_uniform_law_says(
    ends: tuple[float, float], count: int, shares: tuple[float, float]
) -> None:
    width = math.log(ends[1] / ends[0])
    low, high = (min(ends[0] * math.exp(width * share), ends[1]) for share in sorted(shares))
    if high / low < 1.001:
        return
    law, edges = scipy.stats.loguniform(low, high), np.geomspace(*ends, count + 1)
    line = space(*ends, count, target={"x": (low, high)})
    assert line.target_shares.tolist() == pytest.approx(np.diff(law.cdf(edges)), abs=1e-5)


@given(RANGES, st.lists(st.floats(-1, 1), min_size=1, max_size=5))
def test_points_and_levels_are_each_other_s_inverse(
    ends: tuple[float, float], points: list[float]
) -> None:
    line, box = space(*ends), torch.tensor(points, dtype=torch.float64).view(1, -1, 1)
    levels = line.at(box, [Streams(0).generator()])
    law = scipy.stats.loguniform(*ends)
    shares = [(point + 1) / 2 for point in points]
    assert levels["x"][0].tolist() == pytest.approx(law.ppf(shares), rel=1e-9)
    assert torch.allclose(line.place(levels), box, atol=1e-9)
    assert torch.allclose(line.inputs(levels), box, atol=1e-9)  # what a belief sees
    assert ((levels["x"] >= ends[0]) & (levels["x"] <= ends[1])).all()


def test_levels_between_two_are_even_on_the_scale_and_noise_is_too() -> None:
    line = space(0.01, 100.0)
    a, b = (torch.full((4000,), value, dtype=torch.float64) for value in (0.1, 10.0))
    ends = [type(line.sample(1, torch.Generator()))({"x": x}, [4000]) for x in (a, b)]
    between = line.between(*ends, 0.0, Streams(0).generator())["x"]
    assert scipy.stats.kstest(between.numpy(), scipy.stats.loguniform(0.1, 10.0).cdf).pvalue > 0.01
    around = line.between(ends[0], ends[0], 0.05, Streams(0).generator())["x"].log10()
    assert float(around.mean()) == pytest.approx(-1, abs=0.01)
    assert float(around.std()) == pytest.approx(0.05 * 4, rel=0.05)  # of four decades


def test_edits_are_a_tenth_of_the_scale_and_stay_within() -> None:
    line = space(0.01, 100.0)
    levels = line.at(torch.zeros(1, 4000, 1), [Streams(0).generator()])
    edited = line.edit(levels, 1, [Streams(1).generator()])[0]["x"].log10()
    assert float(edited.std()) == pytest.approx(0.4, abs=0.03)
    far = line.edit(levels, 200, [Streams(1).generator()])[0]["x"]
    assert 0.01 <= far.min() < 0.02 and 50 < far.max() <= 100.0


def test_a_file_says_it_as_python_does() -> None:
    file = {"low": 0.01, "high": 1.0, "bins": 4, "log": True, "target": [0.01, 0.03]}
    own = space(0.01, 1.0, 4, target={"x": (0.01, 0.03)})
    read = prl.Parameters({"x": file})
    task, aim = spaces({"x": RangeSettings(**file)}, seeded=False)
    assert read.description == own.description
    plain = prl.Parameters({"x": (0.01, 1.0)}, bins=4, target={"x": (0.01, 0.03)})
    assert own.description != plain.description
    assert str(task.bins["x"]).endswith("(log scale)")
    assert task.shares(aim).tolist() == own.target_shares.tolist()
    for one in (aim, own.target, read.target):
        drawn = one.sample(9, Streams(0).generator())["x"]
        assert drawn.equal(own.target.sample(9, Streams(0).generator())["x"])
    # Measurements from before there was `log` stay comparable with those without it.
    assert "log" not in RangeSettings(low=0.0, high=1.0, target=0.5).measured
    assert RangeSettings(**file).measured["log"] is True


def test_single_values_are_spaced_by_their_logarithms() -> None:
    line = prl.Parameters({"x": {"values": [1, 10, 1000], "log": True}})
    assert line.coordinates[:, 0].tolist() == pytest.approx([-1, -1 / 3, 1])
    levels = line.generate(torch.tensor([[0, 1, 2]]), [torch.Generator()])[0]
    assert levels["x"].tolist() == [1, 10, 1000]
    assert line.inputs(levels)[:, 0].tolist() == pytest.approx([-1, -1 / 3, 1])
    assert line.bins["x"].means("x", levels["x"])["x"] == pytest.approx(10 ** (4 / 3))


@pytest.mark.parametrize(
    ("given_", "target", "message"),
    [
        (prl.Log(0.0, 1.0), None, r"low=0.0 must be below .*, and above 0 on a log"),
        (prl.Log(2.0, 1.0), None, r"low=2.0 must be below high=1.0"),
        ({"low": -1.0, "high": 1.0, "log": True}, None, "low=-1.0 must .* above 0 on a log"),
        ({"values": [0, 1], "log": True}, None, "log=True: needs numbers above 0"),
        ({"values": ["a", "b"], "log": True}, None, "log=True: needs numbers above 0"),
        (prl.Log(0.1, 1.0), (-1.0, 0.5), r"target.x=\(-1.0, 0.5\): must be above 0 on a log"),
    ],
)
def test_what_has_no_logarithm_is_refused(given_: Any, target: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        prl.Parameters({"x": given_}, target=None if target is None else {"x": target})
