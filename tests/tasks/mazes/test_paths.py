from __future__ import annotations

import pytest
import torch

from proposer_rl.tasks.mazes import Level, shortest_path_length
from proposer_rl.tasks.mazes.levels import cells_at_depth, cells_first
from tests.tasks.mazes.oracles import distances, path_length, random_levels


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


def test_longest_path_of_a_snake() -> None:
    level = Level.from_text("S....\n####.\n.....\n.####\n....G")
    assert shortest_path_length(level).item() == 16
