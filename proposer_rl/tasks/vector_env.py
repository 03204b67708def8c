"""Any batched environment of this package, with a space of levels, as environments of Gymnasium."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical, TensorSpec

from proposer_rl.task import Levels, Space

AHEAD = 16  # levels drawn at a time: one costs almost as much as sixteen
RENDER_MODES = ["rgb_array", "ansi"]
METADATA = {"render_modes": RENDER_MODES, "render_fps": 8}

Info = dict[str, Any]
Mask = NDArray[np.bool_]


class LevelVectorEnv(VectorEnv[Any, Any, Any]):
    """n environments that are stepped together, each with a new level in every episode.

    Observations, rewards, ends, levels and autoresets are those of Gymnasium's ``SyncVectorEnv``
    over as many :class:`LevelEnvironment`, with the same seeds. What an environment plays depends
    on its own seed and on how many levels it has drawn, not on the others.

    Args:
        make_env: makes the TorchRL environment of levels [n], on the CPU. It has ``set_levels``,
            actions of one of several, and draws nothing at random.
        space: what levels are drawn from, uniformly over its bins.
        num_envs: n.
        observed: entries of its states that are observed.
        read: reads ``options["level"]``, one level [] or several [n].
        render_mode: ``"rgb_array"``, ``"ansi"`` or None.
        autoreset_mode: ``"NextStep"``: the step after an episode's last one resets, and ignores its
            action. ``"SameStep"``: the last step resets, and the last observation is in
            ``info["final_obs"]``. ``"Disabled"``: ``reset(options={"reset_mask": mask})`` does it,
            which is what TorchRL expects.

    Raises:
        ValueError: if there is no such mode.
    """

    def __init__(
        self,
        make_env: Callable[[Levels], Any],
        space: Space,
        num_envs: int,
        observed: Sequence[str],
        read: Callable[[Any], Levels],
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    ) -> None:
        for name, value, allowed in (
            ("render_mode", render_mode, [None, *RENDER_MODES]),
            ("autoreset_mode", autoreset_mode, [*(m.value for m in AutoresetMode), *AutoresetMode]),
        ):
            if value not in allowed:
                raise ValueError(f"{name} must be one of {allowed}, got {value!r}")
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**METADATA, "autoreset_mode": self.autoreset_mode}
        self.randoms = [seeding.np_random()[0] for _ in range(num_envs)]
        self._space, self._read, self._observed = space, read, sorted(observed)
        seeds = [torch.Generator().manual_seed(0) for _ in range(num_envs)]
        bins = torch.zeros(num_envs, AHEAD, dtype=torch.int64)
        self._drawn = space.generate(bins, seeds)
        self._next = torch.full((num_envs,), AHEAD)  # of the levels drawn ahead; AHEAD: all used
        self._env = make_env(self._drawn[:, 0])
        self._state: TensorDictBase = self._env.reset()
        self._begun = np.zeros(num_envs, dtype=np.bool_)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        seen = {key: _as_space(self._env.observation_spec[key]) for key in self._observed}
        self.single_observation_space = spaces.Dict(seen)
        self.single_action_space = spaces.Discrete(int(self._env.action_spec.n))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def level(self) -> Levels:
        """The levels that are being played, [n]."""
        return self._env.levels

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], Info]:
        """Begin episodes.

        Args:
            seed: of the levels from now on; environment i has ``seed + i``, or the i-th of several.
            options: ``"level"``: one level for all, or one for each, to be played in this episode;
                ``"reset_mask"``: bool [n], True where to reset.

        Raises:
            ValueError: if an option or the number of seeds is wrong.
        """
        given = checked_options(options, "level", "reset_mask")
        levels = self._given(given["level"]) if "level" in given else None
        which = self._mask(given.get("reset_mask"))
        if isinstance(seed, int | np.integer):
            seed = range(int(seed), int(seed) + self.num_envs)
        if seed is not None:
            if not isinstance(seed, Sequence | np.ndarray):
                raise ValueError(f"seed must be a whole number or several, got {seed!r}")
            if len(seed) != self.num_envs:
                raise ValueError(f"seed must be one or {self.num_envs} of them, got {len(seed)}")
            for i in which.nonzero()[0].tolist():
                if seed[i] is not None:
                    self.set_random(i, seeding.np_random(seed[i])[0])
        self._begin(which, levels)
        return self._observe(), {}

    def set_random(self, index: int, random: np.random.Generator) -> None:
        """Take another source of an environment's levels; those drawn ahead are dropped."""
        self.randoms[index] = random
        self._next[index] = AHEAD

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[dict[str, Any], NDArray[np.float64], Mask, Mask, Info]:
        """Make a step everywhere; reset as ``autoreset_mode`` says.

        Raises:
            ValueError: if an action is none.
            gymnasium.error.ResetNeeded: if environments whose episode is over were not reset.
        """
        actions, count = np.asarray(actions), int(self._env.action_spec.n)
        whole = np.issubdtype(actions.dtype, np.integer) and actions.shape == (self.num_envs,)
        if not whole or not ((actions >= 0) & (actions < count)).all():
            raise ValueError(
                f"actions must be {self.num_envs} whole numbers from 0 to {count - 1}, "
                f"got {actions.tolist()!r}"
            )
        resets = self._ended & (self.autoreset_mode is AutoresetMode.NEXT_STEP)
        waiting = ~self._begun | (self._ended & ~resets)
        if waiting.any():
            raise ResetNeeded(
                f"the episode is over in {waiting.sum()} of {self.num_envs}: call reset()"
            )
        action = torch.from_numpy(actions.astype(np.int64))
        after = self._env.step(self._state.set("action", action))["next"]
        self._state = after.exclude("reward")  # which a reset does not give
        reward = after["reward"].squeeze(-1).double().numpy()
        terminated, truncated = (
            after[end].squeeze(-1).numpy().copy() for end in ("terminated", "truncated")
        )
        if resets.any():
            self._begin(resets)
            reward[resets], terminated[resets], truncated[resets] = 0.0, False, False
        self._ended = terminated | truncated
        info: Info = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            last, seen = np.full(self.num_envs, None, dtype=object), self._observe()
            for i in self._ended.nonzero()[0]:
                last[i] = {key: value[i] for key, value in seen.items()}
            ended = {"_final_obs": self._ended.copy(), "_final_info": self._ended.copy()}
            info = {"final_obs": last, "final_info": {}, **ended}
            self._begin(self._ended)
        return self._observe(), reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Draw all: n arrays uint8 [H', W', 3] or n texts, as ``render_mode`` says."""
        if self.render_mode is None:
            return None
        pictures = self._env.render(self.render_mode)
        return tuple(pictures if self.render_mode == "ansi" else pictures.numpy())

    def _begin(self, which: Mask, levels: Levels | None = None) -> None:
        """Begin episodes in some environments, on given levels [n] or on the next ones drawn."""
        mask = torch.from_numpy(which)
        played = self.level.clone()
        played[mask] = self._draw(mask) if levels is None else levels[mask]
        self._env.set_levels(played)
        if which.all():
            self._state = self._env.reset()
        else:
            asked = TensorDict({"_reset": mask.unsqueeze(-1)}, [self.num_envs])
            self._state = self._env.reset(asked).where(mask, self._state)
        self._begun, self._ended = self._begun | which, self._ended & ~which

    def _draw(self, mask: torch.Tensor) -> Levels:
        """The next level of each of m marked environments, from its own randomness: [m]."""
        empty = (mask & (self._next == AHEAD)).nonzero().squeeze(1)
        if empty.numel():
            seeds = [int(self.randoms[i].integers(2**63)) for i in empty.tolist()]
            generators = [torch.Generator().manual_seed(seed) for seed in seeds]
            bins = [torch.randint(self._space.size, (AHEAD,), generator=g) for g in generators]
            self._drawn[empty] = self._space.generate(torch.stack(bins), generators)
            self._next[empty] = 0
        index = mask.nonzero().squeeze(1)
        levels = self._drawn[index, self._next[index]]
        self._next[index] += 1
        return levels

    def _observe(self) -> dict[str, Any]:
        """What is seen now, arrays [n, ...] of their own."""
        return {key: self._state[key].numpy().copy() for key in self._observed}

    def _given(self, level: Any) -> Levels:
        levels = self._read(level)
        if levels.batch_size not in ((), (self.num_envs,)):
            raise ValueError(
                f"options['level'] must be one level or one for each of {self.num_envs}, "
                f"got batch shape {list(levels.batch_size)}"
            )
        return levels.expand(self.num_envs).clone()

    def _mask(self, given: Any) -> Mask:
        mask = np.ones(self.num_envs, dtype=np.bool_) if given is None else np.asarray(given)
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be {self.num_envs} bools, not all False, got {given!r}"
            )
        return mask.copy()


class LevelEnvironment(gymnasium.Env[Any, Any]):
    """One environment, with a new level in every episode.

    ``reset(seed=s)`` decides all levels from then on; ``reset(options={"level": level})`` plays
    that level for one episode.

    Args:
        envs: a vector environment of one, with its autoreset disabled.
    """

    metadata = METADATA

    def __init__(self, envs: LevelVectorEnv) -> None:
        self._envs = envs
        self.render_mode = envs.render_mode
        self.observation_space = envs.single_observation_space
        self.action_space = envs.single_action_space

    @property
    def level(self) -> Levels:
        """The level that is being played, batch shape []."""
        return self._envs.level[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], Info]:
        """Begin an episode.

        Args:
            seed: of the levels from now on; None to go on.
            options: ``{"level": level}`` to give the level of this episode.

        Raises:
            ValueError: if an option is unknown or the level is not one for this environment.
        """
        checked_options(options, "level")
        super().reset(seed=seed)
        if self._envs.randoms[0] is not self.np_random:
            self._envs.set_random(0, self.np_random)
        observation, info = self._envs.reset(options=options)
        return _first(observation), info

    def step(self, action: np.int64 | int) -> tuple[dict[str, Any], float, bool, bool, Info]:
        """Make a step.

        Raises:
            ValueError: if the action is none.
            gymnasium.error.ResetNeeded: if the episode is over.
        """
        observation, *outcome, info = self._envs.step(np.asarray(action).reshape(-1))
        reward, terminated, truncated = (array[0].item() for array in outcome)
        return _first(observation), reward, terminated, truncated, info

    def render(self) -> Any:
        """Draw it: uint8 [H', W', 3] or text, as ``render_mode`` says, else nothing."""
        pictures = self._envs.render()
        return None if pictures is None else pictures[0]


def checked_options(options: Mapping[str, Any] | None, *known: str) -> Mapping[str, Any]:
    """The options of a reset, if all of them are known; else ValueError."""
    unknown = sorted(set(options or {}) - set(known))
    if unknown:
        raise ValueError(f"options must be among {list(known)}, got {unknown[0]!r}")
    return options or {}


def _as_space(spec: TensorSpec) -> spaces.Space[Any]:
    """The space of one of the n environments whose entry a TorchRL specification describes."""
    if isinstance(spec, Categorical):
        return spaces.Discrete(int(spec.n))
    low, high = (end[0].numpy() for end in (spec.space.low, spec.space.high))
    return spaces.Box(low, high, dtype=low.dtype.type)


def _first(observation: dict[str, Any]) -> dict[str, Any]:
    return {key: value[0] for key, value in observation.items()}
