"""The maze as an ordinary Gymnasium environment in Python: a reference for speed and rules."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from proposer_rl.tasks.mazes.levels import MOVES

Observation = dict[str, NDArray[Any]]


class PlainMaze(gymnasium.Env[Observation, int]):
    """One maze with the rules and observations of :class:`~proposer_rl.tasks.mazes.MazeEnv`.

    Args:
        walls: bool [H, W].
        start: row and column.
        goal: row and column.
        max_steps: step limit of an episode.
        step_penalty: cost of a step.
    """

    def __init__(
        self,
        walls: NDArray[np.bool_],
        start: tuple[int, int],
        goal: tuple[int, int],
        max_steps: int,
        step_penalty: float,
    ) -> None:
        self.start = start
        self.goal = goal
        self.max_steps = max_steps
        self.step_penalty = step_penalty
        height, width = walls.shape
        self._free = {(r, c) for r in range(height) for c in range(width) if not walls[r, c]}
        self._planes = np.zeros((3, height, width), np.float32)
        self._planes[0] = walls
        self._planes[1][start] = self._planes[2][goal] = 1
        self.action_space: spaces.Space[Any] = spaces.Discrete(len(MOVES))
        self.observation_space: spaces.Space[Any] = spaces.Dict(
            planes=spaces.Box(0, 1, self._planes.shape, np.float32),
            agent=spaces.MultiDiscrete([height, width]),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Put the agent back to the start; nothing is random."""
        self._agent, self._steps = self.start, 0
        return self._observe(), {}

    def step(self, action: int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move if the cell ahead is free."""
        (row, column), (down, right) = self._agent, MOVES[action]
        ahead = (row + down, column + right)
        if ahead in self._free:
            self._agent = ahead
        self._steps += 1
        terminated = self._agent == self.goal
        truncated = self._steps >= self.max_steps and not terminated
        return self._observe(), float(terminated) - self.step_penalty, terminated, truncated, {}

    def _observe(self) -> Observation:
        return {"planes": self._planes, "agent": np.array(self._agent)}
