"""Edited levels, against what is said of a single edit, cell by cell."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from proposer_rl.tasks.mazes import Level, validate_levels
from proposer_rl.tasks.mazes.generation import edit_levels
from tests.draws import generators
from tests.tasks.mazes.oracles import random_levels

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 6)).filter(lambda size: size[0] * size[1] > 1)
Cell = tuple[int, int]


def copies_of(text: str, count: int) -> Level:
    return Level.from_text(text).expand(1, count)


def changes(before: Level, after: Level) -> tuple[set[Cell], bool, bool]:
    """Cells whose walls differ, and whether start and goal do."""
    flipped = {(r, c) for r, c in (before.walls ^ after.walls).nonzero().tolist()}
    return (
        flipped,
        before.start.tolist() != after.start.tolist(),
        before.goal.tolist() != after.goal.tolist(),
    )


def kinds(before: Level, after: Level) -> list[str]:
    """What became of each of levels [n] by one edit."""
    found = []
    for one, other in zip(before, after, strict=True):
        flipped, start, goal = changes(one, other)
        assert len(flipped) + start + goal <= 1
        found.append("flip" if flipped else "start" if start else "goal" if goal else "none")
    return found


@settings(max_examples=30)
@given(
    size=SIZES,
    fraction=st.sampled_from([0.0, 0.3, 0.8, 1.0]),
    count=st.integers(0, 5),
    seed=st.integers(0, 10_000),
)
def test_edited_levels_are_valid_and_differ_by_no_more_than_the_edits(
    size: tuple[int, int], fraction: float, count: int, seed: int
) -> None:
    levels = random_levels(6, *size, fraction, seed).reshape(2, 3)
    before = levels.clone()
    edited = edit_levels(levels, count, generators(seed, seed + 1))
    assert edited.batch_size == (2, 3)
    validate_levels(edited)
    assert (levels == before).all()
    for one, other in zip(levels.reshape(-1), edited.reshape(-1), strict=True):
        flipped, start, goal = changes(one, other)
        assert len(flipped) + start + goal <= count


@settings(max_examples=30)
@given(size=SIZES, fraction=st.sampled_from([0.3, 1.0]), seed=st.integers(0, 10_000))
def test_an_edit_changes_nothing_only_where_its_operator_is_impossible(
    size: tuple[int, int], fraction: float, seed: int
) -> None:
    levels = random_levels(8, *size, fraction, seed).reshape(1, 8)
    edited = edit_levels(levels, 1, generators(seed))
    free = (~levels.walls[0]).sum((-2, -1)).tolist()
    for kind, room in zip(kinds(levels[0], edited[0]), free, strict=True):
        if kind == "none":
            assert room == 2  # start and goal alone: neither can move
        if kind == "flip":
            assert size[0] * size[1] > 2


def test_no_edits_leave_levels_as_they_are_and_share_no_memory() -> None:
    levels = random_levels(4, 3, 4, 0.3, 0).reshape(2, 2)
    edited = edit_levels(levels, 0, generators(0, 1))
    assert (edited == levels).all()
    edited.walls.logical_not_()
    assert not (edited.walls == levels.walls).any()


def test_a_copys_edits_are_those_of_its_generator_alone() -> None:
    levels = random_levels(24, 4, 5, 0.4, 0).reshape(3, 8)
    together = edit_levels(levels, 4, generators(5, 6, 7))
    for k, seed in enumerate((5, 6, 7)):
        alone = edit_levels(levels[k : k + 1], 4, generators(seed))
        assert (together[k] == alone[0]).all()
    same = edit_levels(levels[:1].expand(2, 8), 4, generators(5, 6))
    assert not (same[0] == same[1]).all()


def test_edits_follow_one_another() -> None:
    """Those of a longer series go on where a shorter one with the same generators stopped."""
    levels = random_levels(16, 4, 4, 0.3, 0).reshape(2, 8)
    draws = generators(1, 2)
    step_by_step = levels
    for _ in range(5):
        step_by_step = edit_levels(step_by_step, 1, draws)
    assert (edit_levels(levels, 5, generators(1, 2)) == step_by_step).all()


def test_the_three_operators_are_equally_likely() -> None:
    before = copies_of("S.#\n..#\n#.G", 6000)
    found = kinds(before[0], edit_levels(before, 1, generators(0))[0])
    counts = [found.count(kind) for kind in ("flip", "start", "goal")]
    assert sum(counts) == 6000
    assert chisquare(counts).pvalue > 1e-3


@pytest.mark.slow
def test_each_operator_chooses_evenly_among_its_cells() -> None:
    before = copies_of("S.#\n..#\n#.G", 18_000)
    after = edit_levels(before, 1, generators(0))[0]
    places: dict[str, list[Cell]] = {"flip": [], "start": [], "goal": []}
    for one, other, kind in zip(before[0], after, kinds(before[0], after), strict=True):
        flipped, _, _ = changes(one, other)
        moved = other.start if kind == "start" else other.goal
        places[kind].append(next(iter(flipped)) if flipped else tuple(moved.tolist()))
    free = {(0, 1), (1, 0), (1, 1), (2, 1)}
    obstacles = {(0, 2), (1, 2), (2, 0)}
    for kind, cells in (("flip", free | obstacles), ("start", free), ("goal", free)):
        assert set(places[kind]) == cells
        assert chisquare([places[kind].count(cell) for cell in cells]).pvalue > 1e-3


def test_where_there_is_no_room_only_obstacles_change() -> None:
    full = copies_of("S#G", 300)
    found = kinds(full[0], edit_levels(full, 1, generators(0))[0])
    assert set(found) == {"flip", "none"}
    assert chisquare([found.count("flip"), found.count("none")], [100, 200]).pvalue > 1e-3
    pair = copies_of("SG", 50)
    assert (edit_levels(pair, 6, generators(0)) == pair).all()
