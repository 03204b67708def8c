"""MultiRoom in small: its target can be reached in time."""

from __future__ import annotations

import heapq
from pathlib import Path

import gymnasium
import pytest
import yaml

minigrid = pytest.importorskip("minigrid")
TASK = yaml.safe_load(Path("conf/task/arena/multiroom.yaml").read_text())["task"]


def fewest_actions(grid: object, place: tuple[int, int], facing: int) -> int | None:
    """The least number of turns, steps and openings of doors to the goal."""
    ways, seen = [(0, *place, facing)], set()
    while ways:
        cost, x, y, way = heapq.heappop(ways)
        cell = grid.get(x, y)
        if cell is not None and cell.type == "goal":
            return cost
        if (x, y, way) in seen:
            continue
        seen.add((x, y, way))
        for turn in (1, 3):
            heapq.heappush(ways, (cost + 1, x, y, (way + turn) % 4))
        x, y = x + (1, 0, -1, 0)[way], y + (0, 1, 0, -1)[way]
        ahead = grid.get(x, y)
        if ahead is None or ahead.type in {"goal", "door"}:
            opened = int(ahead is not None and ahead.type == "door")
            heapq.heappush(ways, (cost + 1 + opened, x, y, way))
    return None


@pytest.mark.parametrize("rooms", TASK["parameters"]["rooms"]["values"])
def test_the_goal_is_within_the_steps(rooms: int) -> None:
    for size in TASK["parameters"]["size"]["values"]:
        env = gymnasium.make(
            TASK["env_id"].partition(":")[2],
            **{"minNumRooms": rooms, "maxNumRooms": rooms, "maxRoomSize": size},
        ).unwrapped
        for seed in range(4):
            env.reset(seed=seed)
            way = fewest_actions(env.grid, tuple(env.agent_pos), env.agent_dir)
            assert way is not None and way < TASK["max_steps"] / 1.2
