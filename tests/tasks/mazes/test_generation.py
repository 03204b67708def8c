from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import combinations, permutations

import pytest
import torch
from scipy.stats import chisquare

from proposer_rl.tasks.mazes import (
    MECHANISMS,
    Level,
    LevelDistribution,
    SpecificationSpace,
    generate_levels,
    shortest_path_length,
    validate_levels,
)
from proposer_rl.tasks.mazes.generation import _open_cells
from tests.draws import generators, seeded
from tests.tasks.mazes.oracles import distances, path_length

BINS = [(fraction / 10, length) for fraction in range(6) for length in range(2, 17, 2)]
Cell = tuple[int, int]


def assert_exact(levels: Level, obstacles: int, length: int) -> None:
    validate_levels(levels)
    assert (levels.walls.sum((-1, -2)) == obstacles).all()
    assert (shortest_path_length(levels) == length).all()
    assert all(path_length(level) == length for level in levels[:10])


@pytest.mark.parametrize(
    ("fraction", "length", "mechanism"),
    [
        *((fraction, length, "uniform") for fraction, length in BINS),
        (0.5, 14, "path_first"),
        (0.4, 1, "path_first"),
        (0.0, 3, "path_first"),
        (0.5, 25, "path_first"),
        (0.5, 20, "uniform"),
    ],
)
def test_levels_are_exact(fraction: float, length: int, mechanism: str) -> None:
    levels = generate_levels([fraction] * 128, length, mechanism=mechanism, generator=seeded())
    assert_exact(levels, round(fraction * 100), length)


@pytest.mark.parametrize("mechanism", MECHANISMS)
@pytest.mark.parametrize(
    ("height", "width", "fraction", "length"),
    [(1, 8, 0.25, 5), (8, 1, 0.0, 7), (3, 7, 0.3, 6), (12, 5, 0.4, 9), (1, 2, 0.0, 1)],
)
def test_other_grids_are_exact(
    mechanism: str, height: int, width: int, fraction: float, length: int
) -> None:
    levels = generate_levels([fraction] * 50, length, height, width, mechanism, seeded())
    assert levels.walls.shape == (50, height, width)
    assert_exact(levels, round(fraction * height * width), length)


@pytest.mark.parametrize("fraction", [0.29, 0.57, 0.145, 0.155, 0.125, 0.135, 0.3])
@pytest.mark.parametrize("dtype", [None, torch.float32, torch.float64])
def test_obstacles_are_rounded_in_float64(fraction: float, dtype: torch.dtype | None) -> None:
    given = fraction if dtype is None else torch.tensor(fraction, dtype=dtype)
    expected = round((fraction if dtype is None else given.item()) * 100)
    assert generate_levels(given, 3, generator=seeded()).walls.sum() == expected


@pytest.mark.parametrize("mechanism", MECHANISMS)
def test_mixed_specifications_keep_their_order(mechanism: str) -> None:
    generator = seeded()
    fraction = torch.randint(2, 6, (4, 50), generator=generator).double() / 10
    length = torch.randint(1, 14, (4, 50), generator=generator)
    levels = generate_levels(fraction, length, mechanism=mechanism, generator=generator)
    assert levels.batch_size == (4, 50)
    assert torch.equal(shortest_path_length(levels), length)
    assert torch.equal(levels.walls.sum((-1, -2)), (fraction * 100).round().long())


def test_shapes_follow_from_broadcasting() -> None:
    assert generate_levels(0.4, 3).batch_size == ()
    assert generate_levels([0.1, 0.2], 3).batch_size == (2,)
    assert generate_levels(torch.zeros(2, 1), torch.ones(3, dtype=torch.int32)).batch_size == (2, 3)
    assert generate_levels(torch.zeros(0), 3).batch_size == (0,)


def test_checking_draws_nothing_from_the_default_generator() -> None:
    state = torch.get_rng_state()
    LevelDistribution(BINS)
    LevelDistribution([(0.5, 14)], "path_first")
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize(
    ("fraction", "length", "grid", "mechanism", "message"),
    [
        (0.9, 12, (10, 10), "uniform", r"0\.9.*12.*10x10.*90 obstacles.*13 free cells of 10"),
        (0.0, 19, (10, 10), "path_first", r"path_length=19.*10x10.*0 obstacles.*18 moves apart"),
        (0.0625, 9, (4, 4), "uniform", r"0\.0625.*9.*1 obstacles.*rarer than 1 in 200,000"),
        (0.0625, 9, (4, 4), "path_first", r"0\.0625.*9.*path_first.*rarer than 1 in 100,000"),
    ],
)
def test_impossible_specifications_are_named(
    fraction: float, length: int, grid: tuple[int, int], mechanism: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        generate_levels([0.0, fraction], [1, length], *grid, mechanism, seeded())
    with pytest.raises(ValueError, match=message):
        LevelDistribution([(0.0, 1), (fraction, length)], mechanism, *grid)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"obstacle_fraction": 1.0}, "obstacle_fraction=1 must be"),
        ({"obstacle_fraction": -0.1}, "obstacle_fraction=-0.1 must be"),
        ({"obstacle_fraction": math.nan}, "obstacle_fraction=nan must be"),
        ({"path_length": 0}, "path_length=0 a whole number of at least 1"),
        ({"path_length": 2.5}, "path_length=2.5 a whole number"),
        ({"height": 0}, "0x10"),
    ],
)
def test_invalid_arguments_are_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        generate_levels(**{"obstacle_fraction": 0.1, "path_length": 2, **arguments})


def assert_distributed(levels: Level, expected: dict[str, float]) -> None:
    """Chi-square test of levels drawn against the probabilities of all possible ones."""
    seen, total = Counter(levels.to_text()), sum(expected.values())
    assert set(seen) <= set(expected)
    counts = [seen[text] for text in expected]
    scale = len(levels) / total
    assert chisquare(counts, [scale * weight for weight in expected.values()]).pvalue > 1e-3


def as_level(walls: set[Cell], start: Cell, goal: Cell, size: int = 3) -> Level:
    return Level(
        walls=torch.tensor([[(r, c) in walls for c in range(size)] for r in range(size)]),
        start=torch.tensor(start),
        goal=torch.tensor(goal),
        batch_size=[],
    )


CELLS = [(row, column) for row in range(3) for column in range(3)]


@pytest.mark.parametrize(("obstacles", "length"), [(2, 4), (3, 3)])
def test_uniform_levels_follow_their_distribution(obstacles: int, length: int) -> None:
    expected: dict[str, float] = {}
    for walls in combinations(CELLS, obstacles):
        for start in set(CELLS) - set(walls):
            field = distances(as_level(set(walls), start, start))
            goals = [cell for cell, distance in field.items() if distance == length]
            for goal in goals:
                expected[as_level(set(walls), start, goal).to_text()] = 1 / len(goals)
    levels = generate_levels([obstacles / 9] * 30_000, length, 3, 3, generator=seeded())
    assert_distributed(levels, expected)


def neighbours(cell: Cell) -> set[Cell]:
    row, column = cell
    around = {(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)}
    return around & set(CELLS)


def carved_paths(path: list[Cell], length: int) -> Iterator[tuple[list[Cell], float]]:
    """All paths without shortcuts that go on from one, with their probabilities."""
    if len(path) == length + 1:
        yield path, 1.0
        return
    choices = [
        cell
        for cell in neighbours(path[-1]) - set(path)
        if neighbours(cell) & set(path) == {path[-1]}
    ]
    for cell in choices:
        for whole, probability in carved_paths([*path, cell], length):
            yield whole, probability / len(choices)


@cache
def moves(walls: frozenset[Cell], start: Cell, goal: Cell) -> int:
    return path_length(as_level(set(walls), start, goal))


def opened(path: list[Cell], order: tuple[Cell, ...], obstacles: int) -> set[Cell] | None:
    """Obstacles left after opening cells one by one, None if too many are."""
    walls = set(CELLS) - set(path)
    for cell in order:
        if len(walls) == obstacles:
            break
        if moves(frozenset(walls - {cell}), path[0], path[-1]) == len(path) - 1:
            walls -= {cell}
    return walls if len(walls) == obstacles else None


@pytest.mark.slow
@pytest.mark.parametrize(("obstacles", "length"), [(2, 4), (3, 3)])
def test_path_first_levels_follow_their_distribution(obstacles: int, length: int) -> None:
    expected: dict[str, float] = defaultdict(float)
    for start in CELLS:
        for path, probability in carved_paths([start], length):
            orders = list(permutations(set(CELLS) - set(path)))
            for order in orders:
                walls = opened(path, order, obstacles)
                if walls is not None:
                    text = as_level(walls, path[0], path[-1]).to_text()
                    expected[text] += probability / len(orders)
    levels = generate_levels(
        [obstacles / 9] * 30_000, length, 3, 3, "path_first", generator=seeded()
    )
    assert_distributed(levels, expected)


def test_opening_many_cells_at_once_equals_one_by_one() -> None:
    """On full grids; the ranks are random, the paths those of levels without other free cells."""
    size, length, free = 8, 9, 40
    bare = generate_levels(
        [1 - (length + 1) / size**2] * 40, length, size, size, "path_first", seeded()
    )
    order = torch.rand(40, size**2, generator=seeded()).masked_fill(~bare.walls.flatten(1), -1)
    rank = order.argsort(1).argsort(1).int()  # [N, H*W]
    start, goal = (cell[:, 0] * size + cell[:, 1] for cell in (bare.start, bare.goal))
    fast, met = _open_cells(
        rank.t().unflatten(0, (size, size)).contiguous(),
        start,
        goal,
        torch.full((40,), length),
        torch.full((40,), free),
    )
    assert met.tolist() == list(range(40))
    skipped = 0
    for i, level in enumerate(bare):
        for cell in rank[i].argsort()[length + 1 :].tolist():
            if (~level.walls).sum() == free:
                break
            level.walls[cell // size, cell % size] = False
            if path_length(level) < length:
                level.walls[cell // size, cell % size] = True
                skipped += 1
        assert torch.equal(fast[..., i], ~level.walls)
    assert skipped > 20


@pytest.mark.parametrize("mechanism", MECHANISMS)
@pytest.mark.parametrize("copies", [1, 3])
def test_one_generator_for_each_index_draws_as_each_alone(mechanism: str, copies: int) -> None:
    # Rare and frequent ones, other ones for each copy, so that some copies need more rounds.
    fractions = torch.tensor([[0.0, 0.4, 0.4, 0.2], [0.5, 0.5, 0.5, 0.1], [0.3, 0.3, 0.0, 0.0]])
    lengths = torch.tensor([[2, 12, 12, 6], [16, 16, 14, 3], [1, 1, 2, 2]])
    fractions, lengths = fractions[:copies].repeat(1, 5), lengths[:copies].repeat(1, 5)

    together = generate_levels(
        fractions, lengths, mechanism=mechanism, generator=generators(*range(copies))
    )
    for k, generator in enumerate(generators(*range(copies))):
        alone = generate_levels(fractions[k], lengths[k], mechanism=mechanism, generator=generator)
        assert (together[k] == alone).all()


SPACE = SpecificationSpace([0.0, 0.25, 0.5], [2, 5], height=6, width=6)


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
