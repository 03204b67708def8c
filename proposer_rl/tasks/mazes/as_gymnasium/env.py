"""The maze as a Gymnasium environment, ``proposer_rl/Maze-v0``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from proposer_rl.tasks.mazes.as_gymnasium.vector import (
    METADATA,
    Info,
    MazeVectorEnv,
    Observation,
    checked_options,
)
from proposer_rl.tasks.mazes.levels import Level


class MazeGymnasiumEnv(gymnasium.Env[Any, Any]):
    """One maze, with a new level of the same specification in every episode.

    Actions, observations (without the step count), rewards and ends are those of
    :class:`~proposer_rl.tasks.mazes.env.MazeEnv`, which this is made of. ``reset(seed=s)`` decides
    all
    levels from then on. ``reset(options={"level": level})`` plays that level, a
    :class:`~proposer_rl.tasks.mazes.levels.Level` or its text, for one episode.

    Args:
        render_mode: ``"rgb_array"``, ``"ansi"`` or None.
        **maze: What a maze of :class:`~proposer_rl.tasks.mazes.as_gymnasium.vector.MazeVectorEnv`
        takes:
            ``obstacle_fraction`` and all that follow it.

    Raises:
        ValueError: If an argument is invalid, or levels cannot be made as specified.
    """

    metadata = METADATA

    def __init__(self, *, render_mode: str | None = None, **maze: Any) -> None:
        self._mazes = MazeVectorEnv(
            1, render_mode=render_mode, autoreset_mode=AutoresetMode.DISABLED, **maze
        )
        self.render_mode = render_mode
        self.observation_space = self._mazes.single_observation_space
        self.action_space = self._mazes.single_action_space

    @property
    def level(self) -> Level:
        """The level that is being played, batch shape ``[]``."""
        level: Level = self._mazes.level[0]
        return level

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begins an episode.

        Args:
            seed: Of the levels from now on; None to go on.
            options: ``{"level": level}`` to choose the level of this episode.

        Raises:
            ValueError: If an option is unknown or the level is not one of this grid.
        """
        checked_options(options, "level")
        super().reset(seed=seed)
        if self._mazes.randoms[0] is not self.np_random:
            self._mazes.set_random(0, self.np_random)
        observation, info = self._mazes.reset(options=options)
        return _first(observation), info

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, Info]:
        """Moves the agent.

        Raises:
            ValueError: If the action is not 0 up, 1 down, 2 left or 3 right.
            gymnasium.error.ResetNeeded: If the episode is over.
        """
        observation, *outcome, info = self._mazes.step(np.asarray(action).reshape(-1))
        reward, terminated, truncated = (array[0].item() for array in outcome)
        return _first(observation), reward, terminated, truncated, info

    def render(self) -> Any:
        """Draws the maze: uint8 ``[H', W', 3]`` or text, as ``render_mode`` says, else nothing."""
        pictures = self._mazes.render()
        return None if pictures is None else pictures[0]


def _first(observation: Observation) -> Observation:
    return {key: value[0] for key, value in observation.items()}
