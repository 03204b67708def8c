from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.tasks.mazes import Level, planes, shortest_path_length, validate_levels
from proposer_rl.tasks.mazes.levels import cells_at_depth, cells_first
from tests.tasks.mazes.oracles import distances, path_length, random_levels

DRAWING = """
    S.#
    .#G
"""


def test_text_is_read_cell_by_cell() -> None:
    level = Level.from_text(DRAWING)
    assert level.batch_size == torch.Size([])
    assert level.walls.tolist() == [[False, False, True], [False, True, False]]
    assert (level.start.tolist(), level.goal.tolist()) == ([0, 0], [1, 2])
    assert (level.walls.dtype, level.start.dtype) == (torch.bool, torch.int64)
    assert level.to_text() == "S.#\n.#G"


@given(
    size=st.tuples(st.integers(1, 6), st.integers(2, 6)),
    fraction=st.floats(0, 1),
    seed=st.integers(0, 10_000),
)
def test_text_round_trip(size: tuple[int, int], fraction: float, seed: int) -> None:
    levels = random_levels(3, *size, fraction, seed)
    assert (Level.from_text(levels.to_text()) == levels).all()


def test_text_of_two_batch_dimensions_is_nested() -> None:
    levels = random_levels(6, 3, 4, 0.3, 0).reshape(2, 3)
    assert levels.to_text() == [[levels[i, j].to_text() for j in range(3)] for i in range(2)]


@pytest.mark.parametrize("drawing", ["", "S.\nG", "S.", "SG\nS.", "S?G", "S . G"], ids=repr)
def test_text_that_is_no_level_is_refused(drawing: str) -> None:
    with pytest.raises(ValueError):
        Level.from_text(drawing)


def test_planes_show_obstacles_start_and_goal() -> None:
    levels = random_levels(8, 4, 5, 0.4, 0).reshape(2, 4)
    result = planes(levels)
    assert (result.shape, result.dtype) == ((2, 4, 3, 4, 5), torch.float32)
    assert torch.equal(result[..., 0, :, :], levels.walls.float())
    for plane, cells in ((1, levels.start), (2, levels.goal)):
        assert result[..., plane, :, :].sum() == 8
        assert all(
            result[i, j, plane, cells[i, j, 0], cells[i, j, 1]] == 1
            for i in range(2)
            for j in range(4)
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"walls": torch.zeros(2, 2, 3)}, "walls must be torch.bool"),
        ({"walls": torch.zeros(2, 3, dtype=torch.bool)}, "walls must be torch.bool"),
        ({"start": torch.zeros(2, 2)}, "start must be torch.int64"),
        ({"goal": torch.zeros(2, 3, dtype=torch.int64)}, "goal must be torch.int64"),
        ({"start": torch.tensor([[0, 0], [0, 3]])}, "1 of 2 levels have the start outside 2x3"),
        ({"goal": torch.tensor([[-1, 2], [1, 2]])}, "1 of 2 levels have the goal outside 2x3"),
        ({"goal": torch.tensor([[0, 2], [0, 2]])}, "2 of 2 levels have the goal on an obstacle"),
        ({"goal": torch.tensor([[1, 2], [0, 0]])}, "1 of 2 .* same cell"),
    ],
)
def test_invalid_levels_are_refused(change: dict[str, torch.Tensor], message: str) -> None:
    level = Level.from_text([DRAWING, DRAWING])
    fields = {name: change.get(name, getattr(level, name)) for name in ("walls", "start", "goal")}
    with pytest.raises(ValueError, match=message):
        validate_levels(Level(**fields, batch_size=[2]))


@pytest.mark.parametrize(
    ("height", "width", "fraction"),
    [(10, 10, 0.4), (10, 10, 0.1), (5, 8, 0.3), (1, 9, 0.1), (9, 1, 0.1), (2, 2, 0.4)],
)
def test_distances_agree_with_networkx(height: int, width: int, fraction: float) -> None:
    levels = random_levels(400, height, width, fraction, seed=height * width)
    lengths = shortest_path_length(levels).tolist()
    assert -1 in lengths and max(lengths) > 1
    for level, length in zip(levels, lengths, strict=True):
        assert length == path_length(level)


@pytest.mark.parametrize("depth", [1, 2, 5, 8])
def test_cells_at_a_depth_agree_with_networkx(depth: int) -> None:
    levels = random_levels(50, 8, 7, 0.3, seed=1)
    source = levels.start[:, 0] * 7 + levels.start[:, 1]
    found = cells_at_depth(cells_first(~levels.walls), source, torch.full((50,), depth))
    assert found.any()
    for level, cells in zip(levels, found.unbind(-1), strict=True):
        expected = [cell for cell, distance in distances(level).items() if distance == depth]
        assert sorted(map(tuple, cells.nonzero().tolist())) == sorted(expected)


@pytest.mark.parametrize("shape", [(), (1,), (2, 3), (0,)])
def test_any_batch_shape(shape: tuple[int, ...]) -> None:
    levels = random_levels(6, 4, 4, 0.2, seed=2)
    count = torch.Size(shape).numel()
    batch = levels[:count].reshape(shape)
    lengths = shortest_path_length(batch)
    assert (lengths.shape, lengths.dtype) == (shape, torch.int64)
    assert lengths.flatten().tolist() == [path_length(level) for level in levels[:count]]
