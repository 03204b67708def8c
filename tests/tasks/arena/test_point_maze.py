"""PointMaze: goals are numbered by their ways from the start, and reached in time."""

from __future__ import annotations

from typing import Any

import networkx
import numpy as np
import pytest

from proposer_rl.cli.build import make_task
from proposer_rl.tasks.gymnasium.player import GymLevel, LevelPlayer
from tests.tiny import composed

pytest.importorskip("gymnasium_robotics")
START = (1, 1)


def test_a_push_from_cell_to_cell_reaches_every_goal() -> None:
    task: Any = make_task(composed("task=arena/point_maze", "+method=target"))
    parameters = task._parameters
    first = {name: given.values[0] for name, given in parameters.items()}
    goals = dict(zip(parameters["goal"].values, map(tuple, parameters["goal"].to), strict=True))
    player = LevelPlayer(task._make, parameters, GymLevel(first, 0), task._success)
    inner: Any = player.unwrapped
    grid = networkx.grid_2d_graph(inner.maze.map_length, inner.maze.map_width)
    grid.remove_nodes_from([*zip(*np.nonzero(np.array(inner.maze.maze_map) == 1), strict=True)])
    ways = networkx.single_source_shortest_path(grid, START)
    assert sorted(goals.values()) == sorted(ways.keys() - {START})
    lengths = [len(ways[cell]) for cell in goals.values()]
    assert lengths == sorted(lengths)
    for goal, cell in goals.items():
        player.play = GymLevel({**first, "goal": goal}, seed=goal)
        player.reset()
        way = [inner.maze.cell_rowcol_to_xy(np.array(place)) for place in ways[cell]]
        way.append(inner.goal)
        over, info = False, {}
        while not over:
            place, speed = inner.point_env.data.qpos, inner.point_env.data.qvel
            if len(way) > 1 and np.linalg.norm(way[0] - place) < 0.3:
                way.pop(0)
            push = 2 * (way[0] - place) - 0.5 * speed
            _, _, terminated, truncated, info = player.step(push.astype(np.float32))
            over = terminated or truncated
        assert info == {"success": True}, cell
    player.close()
