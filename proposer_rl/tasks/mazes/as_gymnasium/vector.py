"""Mazes side by side as a Gymnasium vector environment: :class:`MazeEnv` with NumPy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from numbers import Real
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from proposer_rl.tasks.mazes.distributions import SpecificationSpace
from proposer_rl.tasks.mazes.dynamics import MOVES
from proposer_rl.tasks.mazes.env import MazeEnv
from proposer_rl.tasks.mazes.levels import Level, validate_levels

AHEAD = 16  # levels drawn at a time: one costs almost as much as sixteen
RENDER_MODES = ["rgb_array", "ansi"]
METADATA = {"render_modes": RENDER_MODES, "render_fps": 8}

Observation = dict[str, NDArray[Any]]
Info = dict[str, Any]
Mask = NDArray[np.bool_]


class MazeVectorEnv(VectorEnv[Any, Any, Any]):
    """``num_envs`` mazes that are stepped together, in one batched operation each.

    Observations, rewards, ends, levels and autoresets are those of Gymnasium's ``SyncVectorEnv``
    over as many :class:`~proposer_rl.tasks.mazes.as_gymnasium.env.MazeGymnasiumEnv`, with the same
    seeds.
    What a maze plays depends on its own seed and on how many levels it has drawn, on nothing
    else: not on the other mazes, and not on how many there are.

    Args:
        num_envs: Number n of mazes.
        render_mode: ``"rgb_array"``, ``"ansi"`` or None.
        autoreset_mode: ``"NextStep"``: the step after an episode's last one resets the maze and
            ignores its action. ``"SameStep"``: the last step resets it, and the last observation
            is in ``info["final_obs"]``. ``"Disabled"``: ``reset(options={"reset_mask": mask})``
            does it, which is what TorchRL expects.
        obstacle_fraction: Obstacles per cell; of several, each level has one at random.
        path_length: Moves on the shortest path; of several, each level has one at random.
        height: H, cells.
        width: W, cells.
        mechanism: As in :func:`~proposer_rl.tasks.mazes.generation.generate_levels`.
        max_steps: Steps after which an episode is truncated.
        step_penalty: Cost of a step.
        observe_agent: Whether a fourth plane shows the agent.

    Raises:
        ValueError: If an argument is invalid, or levels cannot be made as specified.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        obstacle_fraction: float | Sequence[float] = 0.4,
        path_length: int | Sequence[int] = 12,
        height: int = 10,
        width: int = 10,
        mechanism: str = "uniform",
        max_steps: int = 25,
        step_penalty: float = 0.01,
        observe_agent: bool = False,
    ) -> None:
        _check_choice("render_mode", render_mode, [None, *RENDER_MODES])
        modes = [*(mode.value for mode in AutoresetMode), *AutoresetMode]
        _check_choice("autoreset_mode", autoreset_mode, modes)
        fractions = _several("obstacle_fraction", obstacle_fraction)
        lengths = _several("path_length", path_length)
        for name, number in (
            ("num_envs", num_envs),
            ("height", height),
            ("width", width),
            ("max_steps", max_steps),
            *(("path_length", length) for length in lengths),
        ):
            if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {number!r}")
        for name, number in (
            ("step_penalty", step_penalty),
            *(("obstacle_fraction", fraction) for fraction in fractions),
        ):
            if isinstance(number, bool) or not isinstance(number, Real) or not isfinite(number):
                raise ValueError(f"{name} must be a finite number, got {number!r}")
        _check_choice("observe_agent", observe_agent, [False, True])
        if max(lengths) > max_steps:
            raise ValueError(
                f"max_steps={max_steps}: must be at least the path length {max(lengths)}, "
                "or no episode can reach the goal"
            )
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**METADATA, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space = spaces.Dict(
            {
                "agent": spaces.Box(0, np.array([height - 1, width - 1]), dtype=np.int64),
                "planes": spaces.Box(0.0, 1.0, (3 + observe_agent, height, width), np.float32),
            }
        )
        self.single_action_space = spaces.Discrete(len(MOVES))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.randoms = [seeding.np_random()[0] for _ in range(num_envs)]
        self._space = SpecificationSpace(fractions, lengths, mechanism, height, width)
        self._drawn = self._space.sample((num_envs, AHEAD), torch.Generator().manual_seed(0))
        self._next = torch.full((num_envs,), AHEAD)  # of each maze's drawn levels; AHEAD: all used
        self._mazes = MazeEnv(
            self._drawn[:, 0],
            max_steps=max_steps,
            step_penalty=step_penalty,
            observe_agent=observe_agent,
        )
        self._state: TensorDictBase = self._mazes.reset()
        self._begun = np.zeros(num_envs, dtype=np.bool_)
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
        chosen = checked_options(options, "level", "reset_mask")
        levels = self._given(chosen["level"]) if "level" in chosen else None
        which = self._mask(chosen.get("reset_mask"))
        if seed is not None:
            if isinstance(seed, int | np.integer):
                seed = range(seed, seed + self.num_envs)
            if not isinstance(seed, Sequence | np.ndarray):
                raise ValueError(f"seed must be a whole number or several, got {seed!r}")
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed must be one or {self.num_envs} of them, got {len(seeds)}")
            for i in which.nonzero()[0].tolist():
                if seeds[i] is not None:
                    self.set_random(i, seeding.np_random(seeds[i])[0])
        self._begin(which, levels)
        return self._observe(), {}

    def set_random(self, maze: int, random: np.random.Generator) -> None:
        """Takes another source of a maze's levels, and drops those drawn ahead from the old one."""
        self.randoms[maze] = random
        self._next[maze] = AHEAD

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[np.float64], Mask, Mask, Info]:
        """Moves every agent; resets mazes as ``autoreset_mode`` says.

        Raises:
            ValueError: If an action is not 0 up, 1 down, 2 left or 3 right.
            gymnasium.error.ResetNeeded: If mazes that are over were not reset (``"Disabled"``).
        """
        actions = self._checked(actions)
        resets = self._ended & (self.autoreset_mode is AutoresetMode.NEXT_STEP)
        waiting = ~self._begun | (self._ended & ~resets)
        if waiting.any():
            raise ResetNeeded(
                f"the episode is over in {waiting.sum()} of {self.num_envs} mazes: call reset()"
            )
        after = self._mazes.step(self._state.set("action", torch.from_numpy(actions)))["next"]
        self._state = after.exclude("reward")  # which a reset does not give
        reward = after["reward"].squeeze(-1).double().numpy()
        terminated = after["terminated"].squeeze(-1).numpy().copy()
        truncated = after["truncated"].squeeze(-1).numpy().copy()
        if resets.any():
            self._begin(resets)
            reward[resets] = 0.0
            terminated &= ~resets
            truncated &= ~resets
        self._ended = terminated | truncated
        info: Info = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            info = self._final()
            self._begin(self._ended)
        return self._observe(), reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Draws the mazes: n arrays uint8 ``[H', W', 3]`` or n texts, as ``render_mode`` says."""
        if self.render_mode is None:
            return None
        pictures = self._mazes.render(self.render_mode)
        return tuple(pictures if self.render_mode == "ansi" else pictures.numpy())

    def _begin(self, which: Mask, levels: Level | None = None) -> None:
        """Begins episodes in some mazes, on given levels ``[n]`` or on the next ones drawn."""
        mask = torch.from_numpy(which)
        chosen = self.level.clone()
        chosen[mask] = self._draw(mask) if levels is None else levels[mask]
        self._mazes.set_levels(chosen)
        everything = bool(which.all())
        call = None if everything else TensorDict({"_reset": mask.unsqueeze(-1)}, [self.num_envs])
        fresh = self._mazes.reset(call)
        self._state = fresh if everything else fresh.where(mask, self._state)
        self._begun = self._begun | which
        self._ended = self._ended & ~which

    def _draw(self, mask: torch.Tensor) -> Level:
        """Takes the next level of each of m marked mazes, from its own randomness: ``[m]``."""
        empty = (mask & (self._next == AHEAD)).nonzero().squeeze(1)
        if empty.numel():
            seeds = [int(self.randoms[i].integers(2**63)) for i in empty.tolist()]
            generators = [torch.Generator().manual_seed(seed) for seed in seeds]
            draws = [torch.randint(self._space.size, (AHEAD,), generator=g) for g in generators]
            self._drawn[empty] = self._space.generate(torch.stack(draws), generators)
            self._next[empty] = 0
        index = mask.nonzero().squeeze(1)
        levels: Level = self._drawn[index, self._next[index]]
        self._next[index] += 1
        return levels

    def _observe(self) -> Observation:
        """The mazes as they are now, arrays ``[n, ...]`` of their own."""
        return {key: self._state[key].numpy().copy() for key in ("agent", "planes")}

    def _final(self) -> Info:
        """What Gymnasium's convention has in the info of mazes that were reset in the same step."""
        observation = self._observe()
        last = np.full(self.num_envs, None, dtype=object)
        for i in self._ended.nonzero()[0]:
            last[i] = {key: value[i] for key, value in observation.items()}
        ended = {"_final_obs": self._ended.copy(), "_final_info": self._ended.copy()}
        return {"final_obs": last, "final_info": {}, **ended}

    def _given(self, level: Level | str | Sequence[str]) -> Level:
        """Levels ``[n]`` that a user gave, one for all mazes or one for each, or drawings."""
        if not isinstance(level, Level):
            drawings = [level] if isinstance(level, str) else level
            if not isinstance(drawings, Sequence) or {*map(type, drawings)} != {str}:
                raise ValueError(f"options['level'] must be a Level or drawings, got {level!r}")
            level = Level.from_text(level)
        validate_levels(level)
        size, own = tuple(level.walls.shape[-2:]), tuple(self._drawn.walls.shape[-2:])
        if size != own:
            raise ValueError(
                "options['level'] must be of the environment's grid "
                f"{own[0]}x{own[1]}, got {size[0]}x{size[1]}"
            )
        if level.batch_size not in ((), (self.num_envs,)):
            raise ValueError(
                f"options['level'] must be one level or one for each of {self.num_envs} mazes, "
                f"got batch shape {list(level.batch_size)}"
            )
        return level.to(torch.device("cpu")).expand(self.num_envs).clone()

    def _mask(self, given: Any) -> Mask:
        if given is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        mask = np.asarray(given)
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be {self.num_envs} bools, not all False, got {given!r}"
            )
        return mask.copy()

    def _checked(self, actions: Any) -> NDArray[np.int64]:
        actions = np.asarray(actions)
        whole = np.issubdtype(actions.dtype, np.integer) and actions.shape == (self.num_envs,)
        if not whole or not ((actions >= 0) & (actions < len(MOVES))).all():
            raise ValueError(
                f"actions must be {self.num_envs} whole numbers from 0 to {len(MOVES) - 1}, "
                f"got {actions.tolist()!r}"
            )
        return actions.astype(np.int64)


def checked_options(options: Mapping[str, Any] | None, *known: str) -> Mapping[str, Any]:
    """The options of a reset, if all of them are known; else ValueError."""
    unknown = sorted(set(options or {}) - set(known))
    if unknown:
        raise ValueError(f"options must be among {list(known)}, got {unknown[0]!r}")
    return options or {}


def _check_choice(name: str, value: object, allowed: Sequence[object]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} must be one of {allowed}, got {value!r}")


def _several(name: str, values: Any) -> list[Any]:
    """One value or several, as a list."""
    listed = list(values) if isinstance(values, Sequence | np.ndarray) else [values]
    if not listed or any(isinstance(v, str | bool) for v in listed):
        raise ValueError(f"{name} must be one number or several, got {values!r}")
    return listed
