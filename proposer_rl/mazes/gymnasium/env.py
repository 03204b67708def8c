"""The maze as Gymnasium environments: ``proposer_rl/Maze-v0``, one at a time or n at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from typing_extensions import Unpack

from proposer_rl.mazes.gymnasium.vector import MazeArguments, MazeBatch, Observation
from proposer_rl.mazes.levels import Level

RENDER_MODES = ["rgb_array", "ansi"]
METADATA = {"render_modes": RENDER_MODES, "render_fps": 8}

Info = dict[str, Any]


class MazeGymnasiumEnv(gymnasium.Env[Any, Any]):
    """One maze, with a new level of the same specification in every episode.

    Actions, observations (without the step count), rewards and ends are those of
    :class:`~proposer_rl.mazes.env.MazeEnv`, which this is made of. ``reset(seed=s)`` decides all
    levels from then on. ``reset(options={"level": level})`` plays that level, a
    :class:`~proposer_rl.mazes.levels.Level` or its text, for one episode.

    Args:
        render_mode: ``"rgb_array"``, ``"ansi"`` or None.
        **maze: See :class:`~proposer_rl.mazes.gymnasium.vector.MazeBatch`.

    Raises:
        ValueError: If an argument is invalid, or levels cannot be made as specified.
    """

    metadata = METADATA

    def __init__(self, *, render_mode: str | None = None, **maze: Unpack[MazeArguments]) -> None:
        self.render_mode = _checked_mode(render_mode)
        self._mazes = MazeBatch(1, **maze)
        self.observation_space = self._mazes.observation_space
        self.action_space = self._mazes.action_space

    @property
    def level(self) -> Level:
        """The level that is being played, batch shape ``[]``."""
        level: Level = self._mazes.levels[0]
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
        chosen = _checked_options(options, "level")
        level = self._mazes.given(chosen["level"]) if "level" in chosen else None
        super().reset(seed=seed)
        everything = np.array([True])
        if seed is not None:
            self._mazes.forget(everything)
        self._mazes.restart(everything, [self.np_random], level)
        return _first(self._mazes.observe()), {}

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, Info]:
        """Moves the agent.

        Raises:
            ValueError: If the action is not 0 up, 1 down, 2 left or 3 right.
            gymnasium.error.ResetNeeded: If the episode is over.
        """
        step = self._mazes.step(np.asarray(action).reshape(-1))
        return (
            _first(step.observation),
            float(step.reward[0]),
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            {},
        )

    def render(self) -> Any:
        """Draws the maze: uint8 ``[H', W', 3]`` or text, as ``render_mode`` says, else nothing."""
        return None if self.render_mode is None else self._mazes.render(self.render_mode)[0]


class MazeVectorEnv(VectorEnv[Any, Any, Any]):
    """``num_envs`` mazes that are stepped together, in one batched operation each.

    Observations, rewards, ends, levels and autoresets are those of Gymnasium's ``SyncVectorEnv``
    over as many :class:`MazeGymnasiumEnv`, with the same seeds.

    Args:
        num_envs: Number n of mazes.
        render_mode: ``"rgb_array"``, ``"ansi"`` or None.
        autoreset_mode: ``"NextStep"``: the step after an episode's last one resets the maze and
            ignores its action. ``"SameStep"``: the last step resets it, and the last observation
            is in ``info["final_obs"]``. ``"Disabled"``: ``reset(options={"reset_mask": mask})``
            does it, which is what TorchRL expects.
        **maze: See :class:`~proposer_rl.mazes.gymnasium.vector.MazeBatch`.

    Raises:
        ValueError: If an argument is invalid, or levels cannot be made as specified.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **maze: Unpack[MazeArguments],
    ) -> None:
        self.render_mode = _checked_mode(render_mode)
        self.autoreset_mode = _checked_autoreset(autoreset_mode)
        self.metadata = {**METADATA, "autoreset_mode": self.autoreset_mode}
        self._mazes = MazeBatch(num_envs, **maze)
        self.num_envs = num_envs
        self.single_observation_space = self._mazes.observation_space
        self.single_action_space = self._mazes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._randoms = [seeding.np_random()[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    @property
    def level(self) -> Level:
        """The levels that are being played, ``[n]``."""
        return self._mazes.levels

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, Info]:
        """Begins episodes.

        Args:
            seed: Of the levels from now on; maze i has ``seed + i``, or the i-th of several.
            options: ``"level"``: one level for all mazes, or one for each, to be played in this
                episode; ``"reset_mask"``: bool ``[n]``, True for the mazes to reset.

        Raises:
            ValueError: If an option or the number of seeds is wrong.
        """
        chosen = _checked_options(options, "level", "reset_mask")
        levels = self._mazes.given(chosen["level"]) if "level" in chosen else None
        which = self._mask(chosen.get("reset_mask"))
        self._seed(seed, which)
        self._mazes.restart(which, self._randoms, levels)
        self._ended = self._ended & ~which
        return self._mazes.observe(), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        """Moves every agent; resets mazes as ``autoreset_mode`` says.

        Raises:
            ValueError: If an action is not 0 up, 1 down, 2 left or 3 right.
            gymnasium.error.ResetNeeded: If mazes that are over were not reset (``"Disabled"``).
        """
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            return self._step_or_reset(actions)
        observation, reward, terminated, truncated = self._mazes.step(actions)
        self._ended = terminated | truncated
        info: Info = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            info = self._final(observation)
            self._mazes.restart(self._ended, self._randoms)
            observation = self._mazes.observe()
        return observation, reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Draws the mazes: n arrays uint8 ``[H', W', 3]`` or n texts, as ``render_mode`` says."""
        return None if self.render_mode is None else tuple(self._mazes.render(self.render_mode))

    def _step_or_reset(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], Info]:
        resets = self._ended
        observation, reward, terminated, truncated = self._mazes.step(actions, idle=resets)
        if resets.any():
            self._mazes.restart(resets, self._randoms)
            observation = self._mazes.observe()
            reward[resets] = 0.0
            terminated &= ~resets
            truncated &= ~resets
        self._ended = terminated | truncated
        return observation, reward, terminated, truncated, {}

    def _final(self, observation: Observation) -> Info:
        """What Gymnasium's convention has in the info of mazes that were reset in the same step."""
        last = np.full(self.num_envs, None, dtype=object)
        for i in self._ended.nonzero()[0]:
            last[i] = {key: value[i] for key, value in observation.items()}
        return {
            "final_obs": last,
            "_final_obs": self._ended.copy(),
            "final_info": {},
            "_final_info": self._ended.copy(),
        }

    def _mask(self, given: Any) -> NDArray[np.bool_]:
        if given is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        mask = np.asarray(given)
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be {self.num_envs} bools, not all False, got {given!r}"
            )
        return mask.copy()

    def _seed(self, seed: int | Sequence[int | None] | None, which: NDArray[np.bool_]) -> None:
        if seed is None:
            return
        seeds = (
            [seed + i for i in range(self.num_envs)]
            if isinstance(seed, int | np.integer)
            else [*seed]
        )
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must be one or {self.num_envs} of them, got {len(seeds)}")
        new = which & np.array([one is not None for one in seeds])
        for i in new.nonzero()[0]:
            self._randoms[i] = seeding.np_random(seeds[i])[0]
        self._mazes.forget(new)


def _first(observation: Observation) -> Observation:
    return {key: value[0] for key, value in observation.items()}


def _checked_mode(mode: str | None) -> str | None:
    if mode is not None and mode not in RENDER_MODES:
        raise ValueError(f"render_mode must be one of {RENDER_MODES} or None, got {mode!r}")
    return mode


def _checked_autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = [each.value for each in AutoresetMode]
        raise ValueError(f"autoreset_mode must be one of {known}, got {mode!r}") from None


def _checked_options(options: Mapping[str, Any] | None, *known: str) -> Mapping[str, Any]:
    unknown = sorted(set(options or {}) - set(known))
    if unknown:
        raise ValueError(f"options must be among {list(known)}, got {unknown[0]!r}")
    return options or {}
