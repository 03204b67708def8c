from __future__ import annotations

import pytest
import torch

from proposer_rl.tasks.mazes import Level, draw_level
from proposer_rl.tasks.mazes.drawings import (
    AGENT_COLOUR,
    DIRECTION_COLOUR,
    FREE_COLOUR,
    GOAL_COLOUR,
    LINE_COLOUR,
    PATH_COLOUR,
    START_COLOUR,
    WALL_COLOUR,
)
from proposer_rl.tasks.view_mazes.view_levels import ViewLevel

LEVEL = Level.from_text("S.#\n..G")
COLOURS = {"S": START_COLOUR, "G": GOAL_COLOUR, "#": WALL_COLOUR, ".": FREE_COLOUR}


def colour(picture: torch.Tensor, row: int, column: int, cell: int) -> tuple[int, ...]:
    """At the centre of a cell."""
    return tuple(picture[row * cell + cell // 2, column * cell + cell // 2].tolist())


@pytest.mark.parametrize("cell", [4, 7, 16])
def test_cells_have_their_colours(cell: int) -> None:
    picture = draw_level(LEVEL, cell=cell)
    assert (picture.shape, picture.dtype) == ((2 * cell + 1, 3 * cell + 1, 3), torch.uint8)
    for row, line in enumerate(LEVEL.to_text().split("\n")):
        for column, mark in enumerate(line):
            assert colour(picture, row, column, cell) == COLOURS[mark]
    assert tuple(picture[cell, 1].tolist()) == tuple(picture[1, -1].tolist()) == LINE_COLOUR


def test_path_connects_cells_and_leaves_the_others() -> None:
    path = [(0, 0), (0, 1), (1, 1), (1, 1)]
    picture = draw_level(LEVEL, path, cell=10)
    for cell in path:
        assert colour(picture, *cell, 10) == PATH_COLOUR
    assert tuple(picture[5, 10].tolist()) == PATH_COLOUR  # also on the line between two cells
    assert colour(picture, 1, 0, 10) == FREE_COLOUR
    assert colour(picture, 1, 2, 10) == GOAL_COLOUR
    assert torch.equal(picture, draw_level(LEVEL, torch.tensor(path), cell=10))


def test_agent_lies_within_its_cell() -> None:
    plain, picture = draw_level(LEVEL, cell=12), draw_level(LEVEL, agent=[1, 1], cell=12)
    changed = (plain != picture).any(-1).nonzero()
    assert colour(picture, 1, 1, 12) == AGENT_COLOUR
    assert changed.amin(0).tolist() > [12, 12] and changed.amax(0).tolist() < [24, 24]


@pytest.mark.parametrize(
    ("mark", "axis", "sign"), [(">", 1, 1), ("v", 0, 1), ("<", 1, -1), ("^", 0, -1)]
)
def test_a_triangle_points_where_the_agent_looks(mark: str, axis: int, sign: int) -> None:
    """It is widest behind, and narrowest in front."""
    picture = draw_level(ViewLevel.from_text(f"#{mark}\nG."), cell=17)[:17, 17:34]
    white = (picture == torch.tensor(DIRECTION_COLOUR)).all(-1)
    widths = white.sum(1 - axis)
    widths = widths[widths > 0]
    assert len(widths) > 6 and (sign * widths.diff() <= 0).all() and white.sum() < 100
    assert widths.amax() > 4 * widths.amin()
