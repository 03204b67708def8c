"""Crossings against MiniGrid's own, map by map, step by step and view by view."""

from __future__ import annotations

from collections import Counter
from itertools import product

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.crossing import CrossingEnv
from tests.tasks.arena.episodes import follow_minigrid, levels

STEPS, SIZES, WALLS = 80, (5, 7, 9, 11), (1, 2, 3, 4, 5)
LIKELY = [0.1, 0.1, 0.7, 0.025, 0.025, 0.025, 0.025]  # of each action


def theirs(size: int, walls: int, **arguments: object) -> object:
    envs = pytest.importorskip("minigrid.envs")
    return envs.CrossingEnv(
        size=size, num_crossings=walls, obstacle_type="wall", max_steps=STEPS, **arguments
    )


def twin(size: int, openings: list[int]) -> object:
    """MiniGrid's environment with the map that an episode of ours begins with."""
    env = theirs(size, 1)
    env.reset(seed=0)
    world_object = pytest.importorskip("minigrid.core.world_object")
    free = {(x, y) for x, y in product(range(1, size - 1), repeat=2)}
    for number, opening in enumerate(openings):
        line = 2 * (number % 4) + 2
        for place in range(1, size - 1):
            if opening and place != opening:
                free -= {(line, place) if number < 4 else (place, line)}
    for x, y in product(range(1, size - 1), repeat=2):
        if (x, y) != (size - 2, size - 2):
            env.grid.set(x, y, None if (x, y) in free else world_object.Wall())
    return env


def turned(env: object, draws: np.random.Generator) -> int:
    """An action of one who goes ahead where there is no wall, and turns at random else."""
    cell = env.grid.get(*env.front_pos)
    blocked = cell is not None and not cell.can_overlap()
    return int(draws.integers(2)) if blocked or draws.random() < 0.2 else 2


def test_steps_and_views_are_those_of_minigrid() -> None:
    """Half of the episodes seldom walk into walls, so that goals are reached."""
    kinds = [*product(SIZES, WALLS)] * 2
    sizes, walls = (torch.tensor(column) for column in zip(*kinds, strict=True))
    env = CrossingEnv(levels(len(kinds), size=sizes, walls=walls), max_steps=STEPS)
    state, draws = env.reset(), np.random.default_rng(0)
    maps = state["state"][:, :8].int().tolist()
    twins = [twin(size, begun) for (size, _), begun in zip(kinds, maps, strict=True)]

    def choose(_: object) -> np.ndarray:
        actions = draws.choice(7, len(kinds), p=LIKELY)
        actions[::2] = [turned(one, draws) for one in twins[::2]]
        return actions

    assert len({kinds[index] for index in follow_minigrid(env, state, twins, choose)}) > 8


@pytest.mark.parametrize(("size", "walls"), [(5, 1), (5, 2), (5, 5), (7, 2), (7, 3), (7, 5)])
def test_maps_are_as_frequent_as_minigrids(size: int, walls: int) -> None:
    """Each map of theirs is drawn about as often, and no other."""
    count = 3000
    begun = CrossingEnv(levels(count, size=size, walls=walls)).reset()["state"]
    ours = Counter(tuple(row) for row in begun[:, :8].int().tolist())
    env, found = theirs(size, walls), Counter()
    env.reset(seed=0)
    lines = [*range(2, size - 2, 2)]
    for _ in range(count):
        env._gen_grid(size, size)
        free = {(x, y) for x, y in product(range(1, size - 1), repeat=2) if not env.grid.get(x, y)}
        free.add((size - 2, size - 2))
        inside = range(1, size - 1)
        rows = [
            [place for place in inside if ((line, place) if upright else (place, line)) in free]
            for upright in (True, False)
            for line in lines
        ]
        key = [0] * 8
        for number, clear in enumerate(rows):
            place = number % len(lines) + 4 * (number // len(lines))
            # A line without a wall is clear but for the walls that cross it.
            key[place] = clear[0] if len(clear) == 1 else 0
        found[tuple(key)] += 1
    if size == 5 or walls > 3:
        assert ours.keys() == found.keys()
    every = ours.keys() | found.keys()
    assert max(abs(ours[key] - found[key]) for key in every) < 0.04 * count
    assert sum(abs(ours[key] - found[key]) for key in every) < 2 * np.sqrt(len(every) * count)


def test_torchrl_finds_nothing_wrong() -> None:
    check_env_specs(
        CrossingEnv(levels(3, size=9, walls=3), max_steps=9), break_when_any_done="both"
    )
