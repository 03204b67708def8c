from __future__ import annotations

import pytest
import torch

from proposer_rl.mazes import Level, distance_field, shortest_path_length
from tests.mazes.oracles import distances, path_length, random_levels


@pytest.mark.parametrize(
    ("height", "width", "fraction"),
    [(10, 10, 0.4), (10, 10, 0.1), (5, 8, 0.3), (1, 9, 0.1), (9, 1, 0.1), (2, 2, 0.4)],
)
def test_distances_agree_with_networkx(height: int, width: int, fraction: float) -> None:
    levels = random_levels(400, height, width, fraction, seed=height * width)
    field = distance_field(levels.walls, levels.start)
    lengths = shortest_path_length(levels).tolist()
    assert -1 in lengths and max(lengths) > 1
    for level, cells, length in zip(levels, field.tolist(), lengths, strict=True):
        expected = distances(level)
        assert cells == [[expected.get((r, c), -1) for c in range(width)] for r in range(height)]
        assert length == path_length(level)


def test_limit_hides_cells_further_away() -> None:
    levels = random_levels(50, 8, 8, 0.3, seed=1)
    full = distance_field(levels.walls, levels.start)
    for limit in (0, 1, 5, 8):
        limited = distance_field(levels.walls, levels.start, limit=limit)
        assert torch.equal(limited, full.masked_fill(full > limit, -1))


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
