"""DoorKey against MiniGrid's own, map by map, step by step and view by view."""

from __future__ import annotations

from collections import deque
from itertools import product

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.doorkey import DoorkeyEnv
from tests.tasks.arena.episodes import follow_minigrid, levels

STEPS, SIZES = 60, (5, 6, 7, 8)
LIKELY = [0.15, 0.15, 0.4, 0.1, 0.05, 0.14, 0.01]  # of each action, so that much happens


def twin(size: int, state: list[float]) -> object:
    """MiniGrid's environment in the state that an episode of ours begins in."""
    world_object = pytest.importorskip("minigrid.core.world_object")
    from minigrid.core.grid import Grid
    from minigrid.envs import DoorKeyEnv

    wall, door, _, key_x, key_y, x, y, way, _ = (int(number) for number in state)
    env = DoorKeyEnv(size=size, max_steps=STEPS)
    env.reset(seed=0)
    env.grid = Grid(size, size)
    env.grid.wall_rect(0, 0, size, size)
    env.grid.vert_wall(wall, 0)
    env.put_obj(world_object.Goal(), size - 2, size - 2)
    env.put_obj(world_object.Door("yellow", is_locked=True), wall, door)
    env.put_obj(world_object.Key("yellow"), key_x, key_y)
    env.agent_pos, env.agent_dir, env.carrying, env.step_count = (x, y), way, None, 0
    return env


def guided(env: object) -> int:
    """The first action of a shortest way to do what comes next: key, door, goal."""
    door = next(cell for cell in env.grid.grid if cell is not None and cell.type == "door")
    aim, do = ("goal", 2) if door.is_open else ("door", 5) if env.carrying else ("key", 3)
    ways, met = deque([(None, *env.agent_pos, env.agent_dir)]), set()
    while True:
        first, x, y, way = ways.popleft()
        to = x + (1, 0, -1, 0)[way], y + (0, 1, 0, -1)[way]
        cell = env.grid.get(*to)
        if cell is not None and cell.type == aim:
            return do if first is None else first
        following = [(0, x, y, (way - 1) % 4), (1, x, y, (way + 1) % 4)]
        if cell is None or cell.can_overlap():
            following.append((2, *to, way))
        for action, *place in following:
            if tuple(place) not in met:
                met.add(tuple(place))
                ways.append((action if first is None else first, *place))


def test_steps_and_views_are_those_of_minigrid() -> None:
    """Half of the episodes are guided to the goal, all of them in time, and half are random."""
    sizes = [size for size in SIZES for _ in range(4)]
    env = DoorkeyEnv(levels(len(sizes), size=torch.tensor(sizes)), max_steps=STEPS)
    state, draws = env.reset(), np.random.default_rng(0)
    twins = [twin(size, begun) for size, begun in zip(sizes, state["state"].tolist(), strict=True)]

    def choose(over: list[bool]) -> np.ndarray:
        actions = draws.choice(7, len(sizes), p=LIKELY)
        actions[::2] = [0 if over[i] else guided(twins[i]) for i in range(0, len(sizes), 2)]
        return actions

    assert follow_minigrid(env, state, twins, choose) >= set(range(0, len(sizes), 2))


@pytest.mark.parametrize("size", SIZES)
def test_maps_are_as_frequent_as_minigrids(size: int) -> None:
    """Each wall, door, place and key that MiniGrid's source draws from, about equally often."""
    count = 6000
    begun = DoorkeyEnv(levels(count, size=size)).reset()["state"].long()
    walls, doors = torch.arange(2, size - 2), torch.arange(1, size - 2)
    for column, values in ((0, walls), (1, doors), (7, torch.arange(4))):
        found, often = begun[:, column].unique(return_counts=True)
        assert found.tolist() == values.tolist()
        assert (often / count - 1 / len(values)).abs().max() < 0.03
    first = begun[begun[:, 0] == 2]  # a single column of cells on this side of the wall
    pairs, often = first[:, [4, 6]].unique(dim=0, return_counts=True)
    rows = range(1, size - 1)
    assert pairs.tolist() == [[key, y] for key, y in product(rows, rows) if key != y]
    assert (often / len(first) - 1 / len(pairs)).abs().max() < 0.03
    assert (begun[:, [3, 5]] < begun[:, :1]).all() and (begun[:, [3, 5]] >= 1).all()


def test_torchrl_finds_nothing_wrong() -> None:
    check_env_specs(DoorkeyEnv(levels(3, size=6), max_steps=9), break_when_any_done="both")
