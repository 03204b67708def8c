"""The maze in Gymnasium, ``proposer_rl/Maze-v0``: what ``gymnasium.make`` and ``make_vec`` call."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from numbers import Real
from typing import Any

import numpy as np

from proposer_rl.tasks.mazes.distributions import SpecificationSpace
from proposer_rl.tasks.mazes.env import MazeEnv
from proposer_rl.tasks.mazes.levels import Level, validate_levels
from proposer_rl.tasks.vector_env import LevelEnvironment, LevelVectorEnv


def make_mazes(
    num_envs: int = 1,
    *,
    obstacle_fraction: float | Sequence[float] = 0.4,
    path_length: int | Sequence[int] = 12,
    height: int = 10,
    width: int = 10,
    mechanism: str = "uniform",
    max_steps: int = 25,
    step_penalty: float = 0.01,
    observe_agent: bool = False,
    **how: Any,
) -> LevelVectorEnv:
    """Mazes that are stepped together; :class:`~proposer_rl.tasks.mazes.env.MazeEnv` has the rules.

    Args:
        num_envs: number n of mazes.
        obstacle_fraction: obstacles per cell; of several, each level has one at random.
        path_length: moves on the shortest path; of several, each level has one at random.
        height: H, cells.
        width: W, cells.
        mechanism: as in :func:`~proposer_rl.tasks.mazes.generation.generate_levels`.
        max_steps: steps after which an episode is truncated.
        step_penalty: cost of a step.
        observe_agent: whether a fourth plane shows the agent.
        **how: ``render_mode`` and ``autoreset_mode``, as of
            :class:`~proposer_rl.tasks.vector_env.LevelVectorEnv`.

    Raises:
        ValueError: if an argument is invalid, or levels cannot be made as specified.
    """
    fractions = _several("obstacle_fraction", obstacle_fraction)
    lengths = _several("path_length", path_length)
    whole = {"num_envs": num_envs, "height": height, "width": width, "max_steps": max_steps}
    for name, number in (*whole.items(), *(("path_length", length) for length in lengths)):
        if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 1:
            raise ValueError(f"{name} must be a whole number of at least 1, got {number!r}")
    several = (("obstacle_fraction", fraction) for fraction in fractions)
    for name, real in (("step_penalty", step_penalty), *several):
        if isinstance(real, bool) or not isinstance(real, Real) or not isfinite(real):
            raise ValueError(f"{name} must be a finite number, got {real!r}")
    if observe_agent not in (False, True):
        raise ValueError(f"observe_agent must be one of [False, True], got {observe_agent!r}")
    if max(lengths) > max_steps:
        raise ValueError(
            f"max_steps={max_steps}: must be at least the path length {max(lengths)}, "
            "or no episode can reach the goal"
        )

    def make(levels: Level) -> MazeEnv:
        return MazeEnv(
            levels, max_steps=max_steps, step_penalty=step_penalty, observe_agent=observe_agent
        )

    def read(level: Any) -> Level:
        """A level or several, or drawings of them."""
        if not isinstance(level, Level):
            drawings = [level] if isinstance(level, str) else level
            if not isinstance(drawings, Sequence) or {*map(type, drawings)} != {str}:
                raise ValueError(f"options['level'] must be a Level or drawings, got {level!r}")
            level = Level.from_text(level)
        validate_levels(level)
        size = tuple(level.walls.shape[-2:])
        if size != (height, width):
            raise ValueError(
                "options['level'] must be of the environment's grid "
                f"{height}x{width}, got {size[0]}x{size[1]}"
            )
        return level.cpu()

    space = SpecificationSpace(fractions, lengths, mechanism, height, width)
    return LevelVectorEnv(make, space, num_envs, ("agent", "planes"), read, **how)


def make_maze(**arguments: Any) -> LevelEnvironment:
    """One maze, with a new level of the same specification in every episode.

    Args:
        **arguments: as of :func:`make_mazes`, with ``render_mode``.
    """
    return LevelEnvironment(make_mazes(1, autoreset_mode="Disabled", **arguments))


def _several(name: str, values: Any) -> list[Any]:
    """One value or several, as a list."""
    listed = list(values) if isinstance(values, Sequence | np.ndarray) else [values]
    if not listed or any(isinstance(v, str | bool) for v in listed):
        raise ValueError(f"{name} must be one number or several, got {values!r}")
    return listed
