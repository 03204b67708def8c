"""The maze in Gymnasium, ``proposer_rl/Maze-v0``: what ``gymnasium.make`` and ``make_vec`` make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, TypeVar

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

from proposer_rl.settings import ArgumentError, Count, checked
from proposer_rl.tasks.mazes.distributions import SpecificationSpace
from proposer_rl.tasks.mazes.dynamics import MOVES
from proposer_rl.tasks.mazes.env import MazeEnv
from proposer_rl.tasks.mazes.levels import Level, validate_levels
from proposer_rl.tasks.mazes.settings import Fractions, MazeSettings, Mechanism, PathLengths

AHEAD = 16  # levels drawn at a time: one costs almost as much as sixteen
METADATA = {"render_modes": ["rgb_array", "ansi"], "render_fps": 8}

N = TypeVar("N", int, float)
Observation = dict[str, Any]
Info = dict[str, Any]
Mask = NDArray[np.bool_]


class VectorMaze(VectorEnv[Any, Any, Any]):
    """n mazes that are stepped together, each with a new level in every episode.

    Observations, rewards, ends, levels and autoresets are those of Gymnasium's ``SyncVectorEnv``
    over as many :class:`SingleMaze`, with the same seeds. What maze i plays depends on its own seed
    and on how many levels it has drawn, not on the others. The rules are those of
    :class:`~proposer_rl.tasks.mazes.env.MazeEnv`.

    Args:
        num_envs: number n of mazes.
        obstacle_fraction: obstacles per cell; of several, each level has one at random.
        path_length: moves on the shortest path; of several, each level has one at random.
        mechanism: as in :func:`~proposer_rl.tasks.mazes.generation.generate_levels`.
        render_mode: what :meth:`render` gives, pictures or texts.
        autoreset_mode: ``"NextStep"``: the step after an episode's last one resets, and ignores its
            action. ``"SameStep"``: the last step resets, and the last observation is in
            ``info["final_obs"]``. ``"Disabled"``: ``reset(options={"reset_mask": mask})`` does it,
            which is what TorchRL expects.
        **maze: ``height``, ``width``, ``max_steps``, ``step_penalty`` and ``observe_agent`` of
            :class:`~proposer_rl.tasks.mazes.settings.MazeSettings`.

    Raises:
        ArgumentError: if an argument is invalid.
        ValueError: if levels cannot be made as specified.
    """

    @checked
    def __init__(
        self,
        num_envs: Count = 1,
        *,
        obstacle_fraction: Fractions = 0.4,
        path_length: PathLengths = 12,
        mechanism: Mechanism = "uniform",
        render_mode: Literal["rgb_array", "ansi"] | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        **maze: Any,
    ) -> None:
        rules = MazeSettings(**maze)
        fractions = _several(obstacle_fraction)
        lengths = _several(path_length)
        if max(lengths) > rules.max_steps:
            raise ArgumentError(
                f"max_steps={rules.max_steps}: must be at least the path length {max(lengths)}, "
                "or no episode can reach the goal"
            )
        grid = self._grid = (rules.height, rules.width)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.autoreset_mode = autoreset_mode
        self.metadata = {**METADATA, "autoreset_mode": autoreset_mode}
        self._randoms = [seeding.np_random()[0] for _ in range(num_envs)]
        self._space = SpecificationSpace(fractions, lengths, mechanism, *grid)
        self._drawn = self._draw([torch.Generator().manual_seed(0) for _ in range(num_envs)])
        self._next = torch.full((num_envs,), AHEAD)  # of the levels drawn ahead; AHEAD: all used
        self._env = MazeEnv(
            self._drawn[:, 0],
            max_steps=rules.max_steps,
            step_penalty=rules.step_penalty,
            observe_agent=rules.observe_agent,
        )
        self._state: TensorDictBase = self._env.reset()
        self._begun = False
        self._over = np.ones(num_envs, np.bool_)
        self.single_observation_space = spaces.Dict(
            agent=spaces.Box(np.zeros(2, np.int64), np.array(grid) - 1, dtype=np.int64),
            planes=spaces.Box(0, 1, (3 + rules.observe_agent, *grid), np.float32),
        )
        self.single_action_space = spaces.Discrete(len(MOVES))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def level(self) -> Level:
        """The levels that are being played, [n]."""
        return self._env.levels

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Observation, Info]:
        """Begin episodes.

        Args:
            seed: of the levels from now on; maze i has ``seed + i``, or the i-th of several.
            options: ``"level"``: one level for all, or one for each, to be played in this episode,
                as ``Level`` or drawings; ``"reset_mask"``: bool [n], True where to reset.

        Raises:
            ValueError: if an option or the number of seeds is wrong.
        """
        given = dict(options or {})
        levels = self._read(given.pop("level")) if "level" in given else None
        which = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, np.bool_)))
        for unknown in given:
            raise ValueError(f"options must be among ['level', 'reset_mask'], got {unknown!r}")
        if which.dtype != np.bool_ or which.shape != (self.num_envs,) or not which.any():
            raise ValueError(
                f"options['reset_mask'] must be {self.num_envs} bools, not all False, got {which}"
            )
        if isinstance(seed, int):
            seed = range(seed, seed + self.num_envs)
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed must be one or {self.num_envs} of them, got {len(seeds)}")
        for i in which.nonzero()[0].tolist():
            if (own := seeds[i]) is not None:
                self._randoms[i] = seeding.np_random(own)[0]
                self._next[i] = AHEAD
        self._begin(which, levels)
        self._begun = True
        return self._observe(), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[np.float64], Mask, Mask, Info]:
        """Make a step everywhere; reset as ``autoreset_mode`` says.

        Raises:
            ValueError: if an action is none.
            gymnasium.error.ResetNeeded: if mazes whose episode is over were not reset.
        """
        if not self.action_space.contains(actions):
            raise ValueError(
                f"actions must be {self.num_envs} whole numbers from 0 to {len(MOVES) - 1}, "
                f"got {actions}"
            )
        resets = self._over & (self._begun and self.autoreset_mode is AutoresetMode.NEXT_STEP)
        if waiting := (self._over & ~resets).sum():
            raise ResetNeeded(f"the episode is over in {waiting} of {self.num_envs}: call reset()")
        self._state.set("action", torch.as_tensor(actions, dtype=torch.int64))
        after = self._env.step(self._state)["next"]
        self._state = after.exclude("reward")  # which a reset does not give
        reward = after["reward"].squeeze(-1).double().numpy()
        terminated, truncated = (
            after[end].squeeze(-1).numpy().copy() for end in ("terminated", "truncated")
        )
        if resets.any():
            self._begin(resets)
            reward[resets], terminated[resets], truncated[resets] = 0.0, False, False
        self._over = terminated | truncated
        info: Info = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._over.any():
            last = self._observe()
            for i in self._over.nonzero()[0].tolist():
                final = {"final_obs": _one(last, i), "final_info": {}}
                info = self._add_info(info, final, i)
            self._begin(self._over)
        return self._observe(), reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Draw all: n arrays uint8 [H', W', 3] or n texts, as ``render_mode`` says."""
        if self.render_mode is None:
            return None
        pictures = self._env.render(self.render_mode)
        return tuple(pictures if self.render_mode == "ansi" else pictures.numpy())

    def _begin(self, which: Mask, levels: Level | None = None) -> None:
        """Begin episodes in some mazes, on given levels [n] or on the next ones drawn."""
        mask = torch.from_numpy(which)
        played = self.level.clone()
        played[mask] = self._next_levels(mask) if levels is None else levels[mask]
        self._env.set_levels(played)
        if which.all():
            self._state = self._env.reset()
        else:
            asked = TensorDict({"_reset": mask.unsqueeze(-1)}, [self.num_envs])
            self._state = self._env.reset(asked).where(mask, self._state)
        self._over = self._over & ~which

    def _next_levels(self, mask: torch.Tensor) -> Level:
        """The next level of each of m marked mazes, from its own randomness: [m]."""
        empty = (mask & (self._next == AHEAD)).nonzero().squeeze(1)
        if len(empty):
            seeds = [int(self._randoms[i].integers(2**63)) for i in empty.tolist()]
            self._drawn[empty] = self._draw([torch.Generator().manual_seed(s) for s in seeds])
            self._next[empty] = 0
        index = mask.nonzero().squeeze(1)
        levels = self._drawn[index, self._next[index]]
        self._next[index] += 1
        return levels

    def _draw(self, generators: Sequence[torch.Generator]) -> Level:
        """Levels [m, AHEAD], uniformly over the specifications, row i from generator i."""
        bins = [torch.randint(self._space.size, (AHEAD,), generator=g) for g in generators]
        return self._space.generate(torch.stack(bins), generators)

    def _observe(self) -> Observation:
        """What is seen now, arrays [n, ...] of their own."""
        return {key: self._state[key].numpy().copy() for key in ("agent", "planes")}

    def _read(self, level: Level | str | Sequence[str]) -> Level:
        """Levels [n] from ``options["level"]``."""
        try:
            levels = level if isinstance(level, Level) else Level.from_text(level)
        except TypeError as error:
            raise ValueError(
                f"options['level'] must be a Level or drawings, got {level!r}"
            ) from error
        validate_levels(levels)
        if (size := tuple(levels.walls.shape[-2:])) != self._grid:
            raise ValueError(
                "options['level'] must be of the environment's grid "
                f"{self._grid[0]}x{self._grid[1]}, got {size[0]}x{size[1]}"
            )
        if levels.batch_size not in ((), (self.num_envs,)):
            raise ValueError(
                f"options['level'] must be one level or one for each of {self.num_envs}, "
                f"got batch shape {list(levels.batch_size)}"
            )
        return levels.cpu().expand(self.num_envs).clone()


class SingleMaze(gymnasium.Env[Any, Any]):
    """One maze, with a new level in every episode.

    ``reset(seed=s)`` decides all levels from then on; ``reset(options={"level": level})`` plays
    that level for one episode.

    Args:
        **arguments: as of :class:`VectorMaze`, but for the number and the autoreset.
    """

    metadata = METADATA

    def __init__(self, **arguments: Any) -> None:
        if "frameskip" in arguments:  # TorchRL's GymEnv tries it, and asks for this very error
            raise TypeError("SingleMaze got an unexpected keyword argument 'frameskip'")
        self._mazes = VectorMaze(1, autoreset_mode=AutoresetMode.DISABLED, **arguments)
        self.render_mode = self._mazes.render_mode
        self.observation_space = self._mazes.single_observation_space
        self.action_space = self._mazes.single_action_space

    @property
    def level(self) -> Level:
        """The level that is being played, batch shape []."""
        return self._mazes.level[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode; see :meth:`VectorMaze.reset`."""
        super().reset(seed=seed)
        observation, info = self._mazes.reset(seed=seed, options=options)
        return _one(observation, 0), info

    def step(self, action: np.int64 | int) -> tuple[Observation, float, bool, bool, Info]:
        """Make a step; see :meth:`VectorMaze.step`."""
        observation, *outcome, info = self._mazes.step(np.asarray(action).reshape(-1))
        reward, terminated, truncated = (array[0].item() for array in outcome)
        return _one(observation, 0), reward, terminated, truncated, info

    def render(self) -> Any:
        """Draw it: uint8 [H', W', 3] or text, as ``render_mode`` says, else nothing."""
        pictures = self._mazes.render()
        return None if pictures is None else pictures[0]


def _several(value: N | list[N]) -> list[N]:
    return value if isinstance(value, list) else [value]


def _one(observation: Observation, index: int) -> Observation:
    return {key: value[index] for key, value in observation.items()}
