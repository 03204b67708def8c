"""The maze as a Gymnasium environment, ``proposer_rl/Maze-v0``."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from tensordict import TensorDictBase

from proposer_rl.settings import ArgumentError, checked
from proposer_rl.tasks.mazes.generation import SpecificationSpace
from proposer_rl.tasks.mazes.levels import MOVES, Level, validate_levels
from proposer_rl.tasks.mazes.maze_env import MazeEnv
from proposer_rl.tasks.mazes.task import Fractions, MazeSettings, Mechanism, PathLengths

LEVELS_AHEAD = 16  # levels drawn at a time; one would cost almost as much
METADATA = {"render_modes": ["rgb_array", "ansi"], "render_fps": 8}

Observation = dict[str, Any]


class SingleMaze(gymnasium.Env[Any, Any]):
    """One maze with the rules of :class:`MazeEnv` and a new level in every episode.

    ``reset(seed=s)`` determines all later levels. ``reset(options={"level": level})`` plays this
    level, a ``Level`` or its drawing, for one episode.

    Args:
        obstacle_fraction: obstacles per cell, or several fractions, of which each level has a
            random one.
        path_length: moves on the shortest path, or several numbers, of which each level has a
            random one.
        mechanism: as in :func:`~proposer_rl.tasks.mazes.generation.generate_levels`.
        render_mode: ``"rgb_array"`` for pictures or ``"ansi"`` for texts from :meth:`render`.
        **maze: ``height``, ``width``, ``max_steps``, ``step_penalty`` and ``observe_agent`` of
            :class:`~proposer_rl.tasks.mazes.task.MazeSettings`.

    Raises:
        ArgumentError: if an argument is invalid.
        ValueError: if levels cannot be made as specified.
    """

    metadata = METADATA

    @checked
    def __init__(
        self,
        *,
        obstacle_fraction: Fractions = 0.4,
        path_length: PathLengths = 12,
        mechanism: Mechanism = "uniform",
        render_mode: Literal["rgb_array", "ansi"] | None = None,
        **maze: Any,
    ) -> None:
        if "frameskip" in maze:  # TorchRL's GymEnv tries it, and expects this error
            raise TypeError("SingleMaze got an unexpected keyword argument 'frameskip'")
        rules = MazeSettings(**maze)
        fractions = (
            obstacle_fraction if isinstance(obstacle_fraction, list) else [obstacle_fraction]
        )
        lengths = path_length if isinstance(path_length, list) else [path_length]
        if max(lengths) > rules.max_steps:
            raise ArgumentError(
                f"max_steps={rules.max_steps}: must be at least the path length {max(lengths)}, "
                "or no episode can reach the goal"
            )
        grid = self._grid = (rules.height, rules.width)
        self.render_mode = render_mode
        self._space = SpecificationSpace(fractions, lengths, mechanism, *grid)
        self._drawn: list[Level] = []
        self._env = MazeEnv(
            self._draw(0)[0],
            max_steps=rules.max_steps,
            step_penalty=rules.step_penalty,
            observe_agent=rules.observe_agent,
        )
        self._state: TensorDictBase | None = None  # None before a reset
        self.observation_space = spaces.Dict(
            agent=spaces.Box(np.zeros(2, np.int64), np.array(grid) - 1, dtype=np.int64),
            planes=spaces.Box(0, 1, (3 + rules.observe_agent, *grid), np.float32),
        )
        self.action_space = spaces.Discrete(len(MOVES))

    @property
    def level(self) -> Level:
        """Returns the level of the current episode, batch shape []."""
        return self._env.levels

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode on a new level, or on that of the options.

        Raises:
            ValueError, RuntimeError: if the options' level does not fit the grid.
        """
        given = options["level"] if options else None
        if given is not None:
            given = given if isinstance(given, Level) else Level.from_text(given)
            validate_levels(given)
        super().reset(seed=seed)
        if seed is not None:
            self._drawn = []
        if given is None and not self._drawn:
            self._drawn = list(self._draw(int(self.np_random.integers(2**63))).unbind(0))
        self._env.set_levels(self._drawn.pop(0) if given is None else given.cpu())
        self._state = self._env.reset()
        return self._observe(self._state), {}

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Makes a step.

        Raises:
            gymnasium.error.ResetNeeded: if the episode is over.
        """
        assert self.action_space.contains(action), f"{action!r} invalid"  # as in Gymnasium's own
        if self._state is None:
            raise ResetNeeded("the episode is over: call reset()")
        after = self._env.step(self._state.set("action", torch.tensor(int(action))))["next"]
        ends = bool(after["terminated"]), bool(after["truncated"])
        self._state = None if any(ends) else after.exclude("reward")  # which a reset does not give
        return self._observe(after), float(after["reward"].double()), *ends, {}

    def render(self) -> Any:
        """Returns a picture uint8 [H', W', 3] or a text, as ``render_mode`` says; else None."""
        if self.render_mode is None:
            return None
        picture = self._env.render(self.render_mode)
        return picture if self.render_mode == "ansi" else picture.numpy()

    def _draw(self, seed: int) -> Level:
        """Draws levels [LEVELS_AHEAD], uniformly over the specifications."""
        generator = torch.Generator().manual_seed(seed)
        bins = torch.randint(self._space.size, (LEVELS_AHEAD,), generator=generator)
        return self._space.generate(bins[None], [generator])[0]

    def _observe(self, state: TensorDictBase) -> Observation:
        return {key: state[key].numpy().copy() for key in ("agent", "planes")}
