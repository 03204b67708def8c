"""Colours: the same for a method everywhere, and apart for every reader."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.recipes import available
from proposer_rl.report.style import (
    DASHES,
    FURTHER,
    METHODS,
    Drawing,
    Look,
    looks,
    render,
    style,
)

# Machado, Oliveira & Fernandes (IEEE TVCG 15, 2009), full severity, on linear RGB.
SEEN_WITHOUT = {
    "red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998]],
    "green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
              [-0.011820, 0.042940, 0.968881]],
}  # fmt: skip
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(colour: str, vision: str | None) -> np.ndarray:
    """CIE L*a*b* of a colour as somebody with that vision sees it."""
    values = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    if vision:
        linear = np.clip(np.array(SEEN_WITHOUT[vision]) @ linear, 0, 1)
    ratio = TO_XYZ @ linear / (TO_XYZ @ np.ones(3))
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("vision", [None, *SEEN_WITHOUT])
def test_methods_can_be_told_apart(vision: str | None) -> None:
    for one, other in itertools.combinations(METHODS.values(), 2):
        # 2.3 is just noticeable side by side; lines in a legend need several times that.
        assert np.linalg.norm(lab(one, vision) - lab(other, vision)) > 15, (one, other)


def test_every_method_has_a_look_of_its_own() -> None:
    found = looks([*available("method"), *(f"further_{i}" for i in range(16))])
    assert len(set(found.values())) == len(found)


def test_an_unknown_method_gets_a_further_look_whatever_else_is_there() -> None:
    assert looks(["plr"])["plr"] == looks(["plr", "perf_gain", "target"])["plr"]
    assert looks(["plr"])["plr"].colour in FURTHER
    assert looks(["perf_gain"])["perf_gain"] == Look(METHODS["perf_gain"])


@given(st.sets(st.text(max_size=4), max_size=len(FURTHER) * len(DASHES)))
def test_looks_are_apart_by_colour_as_long_as_there_are_colours(labels: set[str]) -> None:
    found = list(looks(labels).values())
    assert len(set(found)) == len(labels)
    assert len({(look.colour, look.mark) for look in found}) == len(labels)
    assert len({look.colour for look in found}) == min(len(labels), len(FURTHER))


def test_a_figure_is_the_same_file_every_time() -> None:
    def draw(figure) -> None:
        figure.subplots().plot([0, 1], [1, 0], **style(Look("#332288", "--", "s")))

    drawing = Drawing("d", "D", "", [draw], legend={"plr": Look("#332288", "--", "s")})
    one, two = (render(drawing, "svg", "png") for _ in range(2))
    assert one == two
    assert b"<dc:date>" not in one[0]
