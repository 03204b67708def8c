"""Numbers and pictures of records."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.runs import records
from proposer_rl.runs.records import level_text, number, numbers, pixels, words
from tests.report.folders import LEVEL, PIXELS, png


def test_a_picture_is_what_was_recorded() -> None:
    assert np.array_equal(pixels(LEVEL["picture"]), PIXELS)
    shown = pixels(png(np.full((3, 5), 77, np.uint8)))
    assert shown.shape == (3, 5, 3) and (shown == 77).all()


anything = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=2), inner),
)


@given(anything)
def test_numbers_are_finite_and_of_numbers_alone(value) -> None:
    found = numbers(value)
    if found is not None:
        assert found.shape == (len(value),) and np.isfinite(found).all()
        assert number(value) == pytest.approx(found.mean())
    told = records.flat({"a": value, "shares": {"b": value}})
    assert all(math.isfinite(each) for each in told.values())
    one = number(value)
    assert math.isnan(one) or abs(one) < records.LARGEST


def test_columns_are_told_in_words() -> None:
    assert words("id_greedy_success") == "ID greedy success"
    assert words("target_return") == "target return"
    assert words("all_success") == "all success"
    assert level_text("id_success", 0.8) == "80%" and level_text("id_return", -2.5) == "-2.5"
