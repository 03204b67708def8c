"""Numbers and pictures that may be anything."""

from __future__ import annotations

import base64
import math
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.runs import records
from proposer_rl.runs.records import level_text, number, numbers, picture, words
from tests.report.folders import LEVEL, PIXELS, png


def chunk(kind: bytes, content: bytes) -> bytes:
    check = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)


def bomb(side: int) -> str:
    """A small file that says to be a black square of that side."""
    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(10_000), 9)
    content = chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    return base64.b64encode(b"\x89PNG\r\n\x1a\n" + content).decode()


def test_a_picture_is_what_was_recorded() -> None:
    shown = picture(LEVEL["picture"])
    assert shown is not None and np.array_equal(shown, PIXELS)
    grey = np.full((3, 5), 77, np.uint8)
    shown = picture(png(grey))
    assert shown is not None and shown.shape == (3, 5, 3) and (shown == 77).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("side", [1025, 20_000, 2**31 - 1])
def test_a_huge_picture_is_not_unpacked(side: int) -> None:
    assert picture(bomb(side)) is None


def test_only_png_is_read() -> None:
    gif = base64.b64encode(b"GIF89a\x01\x00\x01\x00\x00\x00\x00;").decode()
    for encoded in (None, 1, "x", "é", gif):
        assert picture(encoded) is None


@given(st.integers(0, 10**6), st.integers(1, 255))
def test_a_changed_picture_is_not_shown(place: int, change: int) -> None:
    content = bytearray(base64.b64decode(LEVEL["picture"]))
    content[place % len(content)] ^= change
    shown = picture(base64.b64encode(content).decode())
    assert shown is None or np.array_equal(shown, PIXELS)


@given(st.binary(max_size=200))
def test_whatever_bytes_there_are_they_are_a_picture_or_none(content: bytes) -> None:
    start = base64.b64decode(LEVEL["picture"])[:33]
    assert picture(base64.b64encode(start + content).decode()) is None


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
    one = number(value)
    assert math.isnan(one) or abs(one) < records.LARGEST


def test_columns_are_told_in_words() -> None:
    assert words("id_greedy_success") == "ID greedy success"
    assert words("target_return") == "target return"
    assert level_text("id_success", 0.8) == "80%" and level_text("id_return", -2.5) == "-2.5"
