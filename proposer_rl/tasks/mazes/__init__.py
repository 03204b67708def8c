"""Mazes: levels, their exact generation, distributions over them, the environment, pictures."""

from __future__ import annotations

from gymnasium import register

from proposer_rl.tasks.mazes.drawings import draw_level
from proposer_rl.tasks.mazes.generation import (
    MECHANISMS,
    LevelDistribution,
    SpecificationSpace,
    generate_levels,
)
from proposer_rl.tasks.mazes.levels import (
    Level,
    LevelSpec,
    planes,
    shortest_path_length,
    successors,
    validate_levels,
)
from proposer_rl.tasks.mazes.maze_env import MazeEnv

__all__ = [
    "MECHANISMS",
    "Level",
    "LevelDistribution",
    "LevelSpec",
    "MazeEnv",
    "SpecificationSpace",
    "draw_level",
    "generate_levels",
    "planes",
    "shortest_path_length",
    "successors",
    "validate_levels",
]

# By name, so that it is imported when one is made.
register("proposer_rl/Maze-v0", entry_point="proposer_rl.tasks.mazes.as_gymnasium:SingleMaze")
