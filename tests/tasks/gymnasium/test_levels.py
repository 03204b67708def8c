"""Bins, targets and where in the bins targets lie."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.streams import Streams
from proposer_rl.tasks.gymnasium.player import ParameterSettings
from proposer_rl.tasks.parameters import Bins, ParameterSpace, points
from proposer_rl.tasks.ranges import spaces
from tests.tasks.gymnasium.toys import PARAMETERS

BINS = {name: settings.space_bins() for name, settings in PARAMETERS.items()}
TARGET = {name: settings.target_bins() for name, settings in PARAMETERS.items()}
SPACE = ParameterSpace(BINS)


RANGE = {"low": 0.0, "high": 3.0}
FOUR = {"low": -4.0, "high": 4.0, "bins": 4}


def test_bins_stand_for_their_middles_and_the_last_parameter_runs_fastest() -> None:
    assert SPACE.axes == {
        "speed": [0.75, 1.25], "width": [1.0, 2.0], "begin": [0, 1], "wind": [-1, 1],
    }  # fmt: skip
    assert SPACE.size == 16
    for choice in range(16):
        (level,) = SPACE.generate(torch.tensor([[choice]]), [Streams(choice).generator()])[0]
        speed, width, begin, wind = (int(digit) for digit in f"{choice:04b}")
        assert 0.5 + 0.5 * speed <= level["speed"] <= 1.0 + 0.5 * speed
        assert (level["width"], level["begin"], level["wind"]) == (1 + width, begin, 2 * wind - 1)


def test_of_a_bin_all_of_its_range_is_drawn_evenly() -> None:
    speed = SPACE.generate(torch.full((1, 4000), 15), [Streams(0).generator()])[0]["speed"]
    counts = torch.histc(speed, 4, min=1.0, max=1.5)
    assert counts.sum() == 4000 and ((counts - 1000).abs() < 4 * 1000**0.5).all()


def test_whole_numbers_stay_whole_and_seeds_differ() -> None:
    levels = SPACE.sample(100, Streams(0).generator())
    assert levels["begin"].dtype == levels["wind"].dtype == levels["seed"].dtype == torch.int64
    assert levels["width"].dtype == torch.float64
    assert len(set(levels["seed"].tolist())) == 100
    target = ParameterSpace(TARGET).sample(100, Streams(0).generator())
    assert {name: entry.dtype for name, entry in target.items()} == {
        name: entry.dtype for name, entry in levels.items()
    }
    assert set(target["begin"].tolist()) == {0, 1} and set(target["wind"].tolist()) == {1}
    assert 1.0 <= target["speed"].min() < target["speed"].max() <= 1.25


NUMBERS = st.floats(-5, 5).map(lambda x: round(x, 2))


def intervals(pair: tuple[float, float]) -> Bins:
    low, high = (torch.tensor([end], dtype=torch.float64) for end in sorted(pair))
    return Bins(low, high)


@given(st.lists(NUMBERS, min_size=1, max_size=5, unique=True), NUMBERS)
def test_a_value_counts_for_the_nearest_one(values: list[float], target: float) -> None:
    values = sorted(values)
    shares = points(values).shares(points([target]))
    nearest = min(abs(value - target) for value in values)
    (chosen,) = shares.nonzero().flatten().tolist()
    assert shares[chosen] == 1 and abs(values[chosen] - target) == pytest.approx(nearest)


@given(st.integers(1, 5), st.tuples(NUMBERS, NUMBERS).filter(lambda pair: pair[0] != pair[1]))
def test_a_range_is_divided_among_the_bins_that_it_covers(
    bins: int, pair: tuple[float, float]
) -> None:
    space = ParameterSettings(low=-3.0, high=2.0, bins=bins, target=0.0).space_bins()
    shares = space.shares(intervals(pair))
    # An even grid within the target, each point counted for its bin.
    low, high = sorted(pair)
    points = low + (high - low) * (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
    place = ((points + 3.0) / 5.0 * bins).floor().clamp(0, bins - 1).long()
    counted = place.bincount(minlength=bins) / 20000
    torch.testing.assert_close(shares, counted.double(), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("range_", "target", "mass"),
    [
        (FOUR, {"distribution": "norm", "loc": 1.0, "scale": 2.0},
         lambda a, b: norm_mass(a, b, 1.0, 2.0)),
        (FOUR, {"values": [-3.0, -2.5, 3.0], "weights": [1.0, 2.0, 5.0]},
         lambda a, b: {-4.0: 3 / 8, 2.0: 5 / 8}.get(a, 0.0)),
        ({"values": [1, 2, 4]}, {"values": [1, 4], "weights": [3, 1]},
         lambda a, b: {1: 3 / 4, 4: 1 / 4}.get(a, 0.0)),
    ],
)  # fmt: skip
def test_a_target_may_be_any_distribution(range_: dict, target: dict, mass: Any) -> None:
    settings = ParameterSettings(**range_, target=target)
    bins, law = settings.space_bins(), settings.target_bins()
    shares, ends = bins.shares(law), list(zip(bins.low.tolist(), bins.high.tolist(), strict=True))
    assert shares.tolist() == pytest.approx([mass(a, b) for a, b in ends])
    drawn = law.draw(torch.zeros(4000, dtype=torch.int64), Streams(0).generator())
    assert drawn.dtype == bins.low.dtype and bins.low[0] <= drawn.min() <= drawn.max()
    assert drawn.max() <= bins.high[-1]
    for share, (low, high) in zip(shares.tolist(), ends, strict=True):
        counted = float(((low <= drawn) & (drawn <= high)).double().mean())
        assert counted == pytest.approx(share, abs=0.04)


def norm_mass(low: float, high: float, loc: float, scale: float) -> float:
    """Returns the mass of a normal cut off at -4 and 4, where what is beyond lies."""
    below = [0.5 + 0.5 * math.erf((end - loc) / scale / 2**0.5) for end in (low, high)]
    return (1.0 if high == 4.0 else below[1]) - (0.0 if low == -4.0 else below[0])


def test_shares_of_several_parameters_multiply() -> None:
    shares = SPACE.shares(ParameterSpace(TARGET))
    drawn = ParameterSpace(TARGET).sample(200, Streams(0).generator())
    assert shares.dtype == torch.float32 and float(shares.sum()) == 1
    fast, wide, windy = drawn["speed"] >= 1, drawn["width"] == 2, drawn["wind"] == 1
    assert (fast & wide & windy).all()
    assert shares.nonzero().flatten().tolist() == [0b1101, 0b1111]


def test_a_single_bin_lies_in_the_middle() -> None:
    only = ParameterSettings(values=[3], target=3).space_bins()
    assert ParameterSpace({"a": only}).coordinates.tolist() == [[0.0]]
    both = ParameterSpace({"a": only, "b": BINS["width"]})
    assert both.coordinates.tolist() == [[0.0, -1.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"target": 1.0}, "needs either values, or low, high and perhaps bins"),
        ({"target": 1.0, "values": [2.0, 1.0]}, r"values=\[2.0, 1.0\] must rise"),
        ({"target": 1.0, "low": 2.0, "high": 2.0, "bins": 1}, "low=2.0 must be below high=2.0"),
        ({"target": 1.5, "values": [1, 2]}, "target=1.5: must be whole"),
        ({"target": 4, "values": [1, 2]}, r"target=4: must be among \[1, 2\]"),
        ({"target": {"values": [4], "weights": [1]}, "values": [1]}, r"target.values=\[4\]: must"),
        ({"target": [2.0, 1.0], **RANGE}, r"target=\(2.0, 1.0\): low=2.0 must be below high=1.0"),
        ({"target": {"distribution": "norm", "skale": 1}, **RANGE}, "target.skale: unknown; there"),
        ({"target": {"distribution": "norm"}, "values": [1.0]}, "of a continuous range only"),
        ({"target": {"values": [1.0], "weights": [1, 2]}, **RANGE}, "must be one for each of 1"),
        ({"target": {"values": [2.0, 1.0], "weights": [1, 1]}, **RANGE}, "must rise"),
    ],
)
def test_what_makes_no_bins_is_refused(given_: dict, message: str) -> None:
    settings = ParameterSettings(**given_)
    with pytest.raises(ValueError, match=message) as refused:
        settings.space_bins(), settings.target_bins()
    assert "\n" not in str(refused.value)


def test_a_file_names_a_part_of_a_range_by_its_ends_and_single_values_by_more() -> None:
    part, three = (
        ParameterSettings(**RANGE, target=target).target_bins()
        for target in ([1.0, 2.0], [0.5, 1.0, 2.0])
    )
    assert (part.low.tolist(), part.high.tolist()) == ([1.0], [2.0])
    assert three.low.tolist() == three.high.tolist() == [0.5, 1.0, 2.0]


@pytest.mark.parametrize(
    ("target", "outside"),
    [
        (0.0, False), (3.0, False), (3.1, True), (-0.1, True), ([1.0, 4.0], False),
        ([2.0, 5.0], True), ({"distribution": "norm", "loc": 9}, True),
        ({"distribution": "norm", "loc": 2}, False), ({"values": [-1, 1], "weights": [2, 1]}, True),
    ],
)  # fmt: skip
def test_a_target_beyond_the_range_is_told(target: Any, outside: bool) -> None:
    """It may be meant, to see how far what is learnt reaches; or a typing error."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        spaces({"mass": ParameterSettings(**RANGE, target=target)})
    assert len(told) == outside
    assert all("lies outside of low=0 to high=3, from which" in str(one.message) for one in told)


def test_without_parameters_levels_lie_along_no_axis() -> None:
    space = ParameterSpace({})
    levels = space.generate(torch.zeros(2, 3).long(), [torch.Generator()] * 2)
    assert space.locate(levels).shape == (2, 3, 0) and space.coordinates.shape == (1, 0)


def test_points_of_the_box_are_levels_of_all_of_the_range() -> None:
    """The ends are the range's, not the middles of bins; single values have equal parts of it."""
    points = torch.linspace(-1, 1, 5).view(1, 5, 1).expand(1, 5, 4)
    levels = SPACE.at(points, [Streams(0).generator()])[0]
    assert levels["speed"].tolist() == [0.5, 0.75, 1.0, 1.25, 1.5]
    assert levels["width"].tolist() == [1.0, 1.0, 2.0, 2.0, 2.0]
    assert levels["begin"].tolist() == [0, 0, 1, 1, 1] and levels["begin"].dtype == torch.int64
    assert levels["wind"].tolist() == [-1, -1, 1, 1, 1] and levels["seed"].unique().numel() == 5


def test_edits_are_gaussian_steps_along_one_parameter() -> None:
    space = ParameterSpace(
        {
            "mass": ParameterSettings(low=0.0, high=10.0, target=1.0).space_bins(),
            "kind": ParameterSettings(values=[1, 2, 4, 8], target=1).space_bins(),
        }
    )
    levels = space.at(torch.zeros(1, 4000, 2), [Streams(0).generator()])
    edited = space.edit(levels, 1, [Streams(1).generator()])[0]
    moved = edited["mass"] != 5.0
    assert not (moved & (edited["kind"] != 4)).any() and abs(moved.double().mean() - 0.5) < 0.04
    assert float(edited["mass"][moved].std()) == pytest.approx(1.0, abs=0.1)  # a tenth of 10
    assert set(edited["kind"][~moved].tolist()) == {1, 2, 8}  # one or two places further
    assert torch.equal(edited["seed"], levels["seed"][0])
    far = space.edit(levels, 100, [Streams(1).generator()])[0]
    assert 0.0 <= far["mass"].min() < 0.5 < 9.5 < far["mass"].max() <= 10.0


def test_the_only_bin_of_a_range_is_located_between_its_ends() -> None:
    """What models of outcomes see of a range that has no bins."""
    space = ParameterSpace({"mass": ParameterSettings(low=2.0, high=6.0, target=2.0).space_bins()})
    levels = space.at(torch.tensor([[[-1.0], [0.5], [1.0]]]), [Streams(0).generator()])
    assert space.locate(levels).flatten().tolist() == [-1.0, 0.5, 1.0]
    assert space.coordinates.tolist() == [[0.0]]
