"""MiniGrid's own environment on one of our levels, and random levels for it."""

from __future__ import annotations

from typing import Any

import torch
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Goal, Wall
from minigrid.minigrid_env import MiniGridEnv

from proposer_rl.mazes.levels import cell_position
from proposer_rl.mazes.view.levels import ViewLevel


class OracleEnv(MiniGridEnv):
    """One level inside of MiniGrid's border of walls."""

    def __init__(self, level: ViewLevel, max_steps: int) -> None:
        self._level = level
        height, width = level.walls.shape
        super().__init__(
            mission_space=MissionSpace(lambda: "reach the goal"),
            width=width + 2,
            height=height + 2,
            max_steps=max_steps,
            see_through_walls=True,
            agent_view_size=5,
        )

    def _gen_grid(self, width: int, height: int) -> None:
        self.grid = Grid(width, height)
        self.grid.wall_rect(0, 0, width, height)
        for row, column in self._level.walls.nonzero().tolist():
            self.grid.set(column + 1, row + 1, Wall())
        row, column = self._level.goal.tolist()
        self.grid.set(column + 1, row + 1, Goal())
        row, column = self._level.start.tolist()
        self.agent_pos, self.agent_dir = (column + 1, row + 1), int(self._level.direction)
        self.mission = "reach the goal"


def random_levels(count: int, side: int = 13, seed: int = 0) -> ViewLevel:
    """Levels [count] of up to a third of walls; every second goal is a few cells from the start."""
    draw: Any = torch.Generator().manual_seed(seed)
    share = torch.rand(count, 1, generator=draw) / 3
    walls = torch.rand(count, side**2, generator=draw) < share
    ranks = torch.rand(count, side**2, generator=draw).argsort(1)
    start, goal = ranks[:, 0], ranks[:, 1]
    near = torch.randint(1, 3, (count,), generator=draw)
    beside = torch.where(start % side + near < side, start + near, start - near)
    goal = torch.where(torch.arange(count) % 2 == 0, goal, beside)
    for cell in (start, goal):
        walls[torch.arange(count), cell] = False
    return ViewLevel(
        walls=walls.view(count, side, side),
        start=cell_position(start, side),
        goal=cell_position(goal, side),
        direction=torch.randint(4, (count,), generator=draw),
        batch_size=[count],
    )
