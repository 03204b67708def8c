"""Mazes: levels, their exact generation, distributions over them, the environment, pictures."""

from gymnasium import register

from proposer_rl.tasks.mazes.drawings import draw_level as draw_level
from proposer_rl.tasks.mazes.generation import MECHANISMS as MECHANISMS
from proposer_rl.tasks.mazes.generation import LevelDistribution as LevelDistribution
from proposer_rl.tasks.mazes.generation import SpecificationSpace as SpecificationSpace
from proposer_rl.tasks.mazes.generation import generate_levels as generate_levels
from proposer_rl.tasks.mazes.levels import Level as Level
from proposer_rl.tasks.mazes.levels import LevelSpec as LevelSpec
from proposer_rl.tasks.mazes.levels import planes as planes
from proposer_rl.tasks.mazes.levels import shortest_path_length as shortest_path_length
from proposer_rl.tasks.mazes.levels import successors as successors
from proposer_rl.tasks.mazes.levels import validate_levels as validate_levels
from proposer_rl.tasks.mazes.maze_env import MazeEnv as MazeEnv

# By name, so that the module is imported only when a maze is made.
register("proposer_rl/Maze-v0", entry_point="proposer_rl.tasks.mazes.as_gymnasium:SingleMaze")
