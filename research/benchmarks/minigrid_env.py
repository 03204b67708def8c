"""MiniGrid's own environment on a level of ours: what is measured, and tested, against."""

from __future__ import annotations

from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Goal, Wall
from minigrid.minigrid_env import MiniGridEnv

from proposer_rl.tasks.view_mazes.view_levels import ViewLevel


class MiniGridMaze(MiniGridEnv):
    """One level inside of MiniGrid's border of walls, seen as the field sees it."""

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
