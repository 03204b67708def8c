"""Drawings of levels with a direction, their generators, and shortest ways, against networkx."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import networkx as nx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from proposer_rl.tasks.mazes.levels import shortest_path_length, validate_levels
from proposer_rl.tasks.view_mazes.view_env import fewest_actions, optimal_view_return
from proposer_rl.tasks.view_mazes.view_levels import (
    AHEAD,
    PerfectSettings,
    ScatteredSettings,
    ViewDistribution,
    ViewDistributionSettings,
    ViewLevel,
    ViewSpace,
    ViewSpaceSettings,
    perfect_mazes,
    scattered_walls,
    solvable,
)
from tests.tasks.view_mazes.oracles import random_levels

CPU = torch.device("cpu")


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cells(level: ViewLevel) -> nx.Graph:
    """Free cells, those beside each other joined."""
    graph = nx.grid_2d_graph(*level.walls.shape)
    graph.remove_nodes_from(map(tuple, level.walls.nonzero().tolist()))
    return graph


def turns_and_moves(level: ViewLevel) -> nx.DiGraph:
    """Cells with directions, joined by single actions."""
    graph, free = nx.DiGraph(), cells(level)
    for row, column in free:
        for direction, (down, right) in enumerate(AHEAD):
            here = (row, column, direction)
            for turned in ((direction + 1) % 4, (direction - 1) % 4):
                graph.add_edge(here, (row, column, turned))
            if (row + down, column + right) in free:
                graph.add_edge(here, (row + down, column + right, direction))
    return graph


@given(st.integers(0, 2**32))
def test_drawings_are_read_back(seed: int) -> None:
    levels = random_levels(3, side=5, seed=seed)
    again = ViewLevel.from_text(levels.to_text())
    assert bool((again == levels).all())
    assert bool((ViewLevel.from_text(levels[0].to_text()) == levels[0]).all())
    validate_levels(again)


def test_a_start_without_direction_looks_right() -> None:
    assert int(ViewLevel.from_text("S.G").direction) == 0
    for direction, mark in enumerate(">v<^"):
        assert int(ViewLevel.from_text(f"{mark}.G").direction) == direction


@pytest.mark.parametrize("drawing", [">.<G", "...G", ">..", ">.x.G", ">.G\n."])
def test_what_is_no_level_is_refused(drawing: str) -> None:
    with pytest.raises(ValueError, match="a level"):
        ViewLevel.from_text(drawing)


def test_directions_are_checked() -> None:
    levels = random_levels(3)
    for wrong in (torch.tensor([0, 4, 1]), torch.tensor([0, -1, 1])):
        with pytest.raises(ValueError, match="1 of 3 levels have the direction outside"):
            validate_levels(levels.replace(direction=wrong))
    with pytest.raises(ValueError, match="direction must be"):
        validate_levels(levels.replace(direction=torch.zeros(3)))


def test_shortest_ways_are_those_of_networkx() -> None:
    levels = random_levels(40, side=6, seed=3)
    found = fewest_actions(levels)
    assert (found < 0).any() and (found > 8).any()
    for level, actions in zip(levels, found.tolist(), strict=True):
        lengths = nx.single_source_shortest_path_length(
            turns_and_moves(level), (*level.start.tolist(), int(level.direction))
        )
        there = [(*level.goal.tolist(), direction) for direction in range(4)]
        assert actions == min((lengths[at] for at in there if at in lengths), default=-1)
    folded = fewest_actions(levels.reshape(5, 8))
    assert torch.equal(folded.flatten(), found)


class Reads(TorchDispatchMode):
    """Counts numbers that are handed to Python, for which a GPU's host would wait."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += func.overloadpacket.__name__ == "_local_scalar_dense"
        return func(*args, **(kwargs or {}))


def test_shortest_ways_are_found_without_waiting_at_each_step() -> None:
    levels = perfect_mazes(8, 9, 9, generator())
    with Reads() as reads:
        longest = fewest_actions(levels).amax()
    assert longest > 24 and 1 <= reads.count <= longest / 8 + 1


def test_the_optimum_is_a_shortest_way_within_the_limit() -> None:
    levels = ViewLevel.from_text([">.G", "<.G", ">#G"])
    torch.testing.assert_close(optimal_view_return(levels, 10), torch.tensor([0.82, 0.64, 0.0]))
    torch.testing.assert_close(optimal_view_return(levels, 3), torch.tensor([0.4, 0.0, 0.0]))


def test_perfect_mazes_are_valid() -> None:
    for height, width in ((13, 13), (5, 9)):
        levels = perfect_mazes(20, height, width, generator())
        validate_levels(levels)
        assert (shortest_path_length(levels) > 0).all()
        assert bool((perfect_mazes(20, height, width, generator()) == levels).all())
        assert not (levels.walls[0] == levels.walls[1:]).flatten(1).all(1).all()
        for level in levels:
            assert nx.is_tree(cells(level))


def test_a_search_reaches_every_maze() -> None:
    """Of 2x2 rooms there are four mazes; each leaves out one of four passages."""
    walls = perfect_mazes(400, 3, 3, generator()).walls.flatten(1)
    assert len(walls.unique(dim=0)) == 4


def test_scattered_walls_are_counted_and_uniform() -> None:
    count = torch.tensor([0, 3, 7]).repeat(2000)
    levels = scattered_walls(count, 3, 3, generator())
    validate_levels(levels)
    assert torch.equal(levels.walls.flatten(1).sum(1), count)
    three = levels[count == 3]
    for places in (three.walls.flatten(1).float().mean(0) / 3, *ends(three)):
        torch.testing.assert_close(places, torch.full((9,), 1 / 9), atol=0.03, rtol=0)
    shares = levels.direction.bincount(minlength=4) / len(levels)
    torch.testing.assert_close(shares, torch.full((4,), 0.25), atol=0.03, rtol=0)


def ends(levels: ViewLevel) -> list[torch.Tensor]:
    """Shares of the nine cells as start and as goal; three of nine cells are walls."""
    numbers = [cell[:, 0] * 3 + cell[:, 1] for cell in (levels.start, levels.goal)]
    return [number.bincount(minlength=9) / len(levels) for number in numbers]


@pytest.mark.parametrize(
    "settings",
    [ScatteredSettings(fewest=2, most=9, solvable=True), PerfectSettings()],
)
def test_distributions(settings: ViewDistributionSettings) -> None:
    levels = ViewDistribution(settings, 5, 5, CPU).sample(200, generator())
    assert levels.batch_size == (200,) and (shortest_path_length(levels) > 0).all()
    if isinstance(settings, ScatteredSettings):
        walls = levels.walls.flatten(1).sum(1)
        assert (int(walls.min()), int(walls.max())) == (2, 9)


def test_a_bin_has_its_walls_and_its_path() -> None:
    space = ViewSpace(ViewSpaceSettings(walls=[0, 5], path_lengths=[1, 3, 6]), 5, 5, CPU)
    assert space.axes == {"walls": (0, 5), "path length": (1, 3, 6)} and space.size == 6
    choices = torch.arange(6).repeat(2, 3)
    levels = space.generate(choices, [generator(), generator(1)])
    validate_levels(levels)
    assert torch.equal(levels.walls.sum((-2, -1)), torch.tensor([0, 5])[choices // 3])
    assert torch.equal(shortest_path_length(levels), torch.tensor([1, 3, 6])[choices % 3])
    assert torch.equal(space.shares(levels[0]), torch.full((6,), 1 / 6))


def test_without_lengths_a_goal_may_be_out_of_reach() -> None:
    space = ViewSpace(ViewSpaceSettings(walls=[0, 12]), 5, 5, CPU)
    levels = space.sample(300, generator())
    walls = levels.walls.flatten(1).sum(1)
    assert set(walls.tolist()) == {0, 12}
    length = shortest_path_length(levels)
    assert (length[walls == 0] > 0).all() and (length < 0).any()
    torch.testing.assert_close(space.shares(levels)[0], (walls == 0).float().mean())


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: ViewDistribution(PerfectSettings(), 4, 5, CPU), "odd sides, got 4x5"),
        (lambda: ViewDistribution(ScatteredSettings(most=24), 5, 5, CPU), "at most 23 walls"),
        (lambda: solvable(lambda n: ViewLevel.from_text([">#G"] * n), 2), "could not be reached"),
        (lambda: ViewSpace(ViewSpaceSettings(walls=[24]), 5, 5, CPU), "at most 23 walls"),
        (lambda: ViewSpace(ViewSpaceSettings(walls=[0], path_lengths=[9]), 5, 5, CPU),
         "path_length=9"),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused(make: Callable[[], object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()
