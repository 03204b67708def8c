from __future__ import annotations

import pytest
import torch
from scipy.stats import chisquare

from proposer_rl.tasks.mazes import LevelDistribution, SpecificationSpace, shortest_path_length
from tests.draws import seeded

SPACE = SpecificationSpace([0.0, 0.25, 0.5], [2, 5], height=6, width=6)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), 5])
@pytest.mark.parametrize("mechanism", ["uniform", "path_first"])
def test_distribution_gives_its_specification(shape: tuple[int, ...] | int, mechanism: str) -> None:
    distribution = LevelDistribution([(0.3, 6)], mechanism, height=5, width=8)
    levels = distribution.sample(shape, seeded())
    assert levels.batch_size == torch.zeros(shape).shape
    assert (levels.walls.sum((-1, -2)) == 12).all()
    assert (shortest_path_length(levels) == 6).all()
    assert (levels == distribution.sample(shape, seeded())).all()


def test_impossible_distribution_is_refused_at_once() -> None:
    with pytest.raises(ValueError, match=r"0\.95.*path_length=12"):
        LevelDistribution([(0.1, 3), (0.95, 12)])
    with pytest.raises(ValueError, match=r"0\.9.*path_length=30"):
        SpecificationSpace([0.1, 0.9], [2, 30])


def test_numbers_run_through_lengths_first() -> None:
    assert SPACE.size == 6
    assert SPACE.axes == {"obstacle fraction": (0.0, 0.25, 0.5), "path length": (2, 5)}
    fraction, length = SPACE.decode(torch.arange(6).view(3, 2))
    assert fraction.dtype == torch.float64
    assert fraction.tolist() == [[0.0, 0.0], [0.25, 0.25], [0.5, 0.5]]
    assert length.tolist() == [[2, 5]] * 3


def test_sampling_is_uniform_over_the_space() -> None:
    levels = SPACE.sample((60, 100), seeded())
    row = levels.walls.sum((-1, -2)) // 9
    index = row * 2 + (shortest_path_length(levels) == 5)
    counts = index.flatten().bincount(minlength=6)
    assert counts.sum() == 6000
    assert chisquare(counts.tolist()).pvalue > 1e-3
    assert (levels == SPACE.sample((60, 100), seeded())).all()


def test_coordinates_run_from_minus_one_to_one_along_each_axis() -> None:
    assert SPACE.coordinates.tolist() == [[-1, -1], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 1]]
    single = SpecificationSpace([0.25], [2, 5], height=6, width=6)
    assert single.coordinates.tolist() == [[0, -1], [0, 1]]
    single = SpecificationSpace([0.0, 0.25], [2], height=6, width=6)
    assert single.coordinates.tolist() == [[-1, 0], [1, 0]]
    assert single.nearest(single.specifications).tolist() == [0, 1]
