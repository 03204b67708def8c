"""What both Gymnasium environments are made of: mazes side by side, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypedDict

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.mazes.distributions import SpecificationSpace
from proposer_rl.mazes.dynamics import MOVES
from proposer_rl.mazes.env import MazeEnv
from proposer_rl.mazes.levels import Level, validate_levels

AHEAD = 16  # levels drawn at a time: one costs almost as much as sixteen

Observation = dict[str, NDArray[Any]]
GivenLevel = Level | str | Sequence[str]


class MazeArguments(TypedDict, total=False):
    """Keyword arguments of both environments; see :class:`MazeBatch`."""

    obstacle_fraction: float | Sequence[float]
    path_length: int | Sequence[int]
    height: int
    width: int
    mechanism: str
    max_steps: int
    step_penalty: float
    observe_agent: bool


class Step(NamedTuple):
    """What a step of n mazes gives; every array is new."""

    observation: Observation
    reward: NDArray[np.float64]  # [n]
    terminated: NDArray[np.bool_]  # [n]
    truncated: NDArray[np.bool_]  # [n]


class MazeBatch:
    """``n`` mazes with a drawn level each: :class:`MazeEnv` with arrays instead of tensordicts.

    Args:
        count: n.
        obstacle_fraction: Obstacles per cell; of several, each level has one at random.
        path_length: Moves on the shortest path; of several, each level has one at random.
        height: H, cells.
        width: W, cells.
        mechanism: As in :func:`~proposer_rl.mazes.generation.generate_levels`.
        max_steps: Steps after which an episode is truncated.
        step_penalty: Cost of a step.
        observe_agent: Whether a fourth plane shows the agent.

    Raises:
        ValueError: If an argument is invalid, or levels cannot be made as specified.
    """

    def __init__(
        self,
        count: int = 1,
        *,
        obstacle_fraction: float | Sequence[float] = 0.4,
        path_length: int | Sequence[int] = 12,
        height: int = 10,
        width: int = 10,
        mechanism: str = "uniform",
        max_steps: int = 25,
        step_penalty: float = 0.01,
        observe_agent: bool = False,
    ) -> None:
        for name, number in (
            ("num_envs", count),
            ("height", height),
            ("width", width),
            ("max_steps", max_steps),
        ):
            _check_whole(name, number)
        fractions = _several("obstacle_fraction", obstacle_fraction)
        lengths = _several("path_length", path_length)
        for length in lengths:
            _check_whole("path_length", length)
        if max(lengths) > max_steps:
            raise ValueError(
                f"max_steps={max_steps}: must be at least the path length {max(lengths)}, "
                "or no episode can reach the goal"
            )
        space = SpecificationSpace(fractions, lengths, mechanism, height, width)
        self.grid = (height, width)
        self.count = count
        self._queue = _LevelQueue(space, count)
        self._mazes = MazeEnv(
            space.sample(count, torch.Generator().manual_seed(0)),
            max_steps=max_steps,
            step_penalty=step_penalty,
            observe_agent=observe_agent,
        )
        self._state: TensorDictBase = self._mazes.reset()
        self._over = torch.ones(count, dtype=torch.bool)  # whether a maze waits for a reset
        planes = 4 if observe_agent else 3
        self.observation_space = spaces.Dict(
            {
                "agent": spaces.Box(0, np.array([height - 1, width - 1]), dtype=np.int64),
                "planes": spaces.Box(0.0, 1.0, (planes, height, width), np.float32),
            }
        )
        self.action_space = spaces.Discrete(len(MOVES))

    @property
    def levels(self) -> Level:
        """The levels that are being played, ``[n]``."""
        return self._mazes.levels

    def restart(
        self,
        which: NDArray[np.bool_],
        randoms: Sequence[np.random.Generator],
        levels: Level | None = None,
    ) -> None:
        """Begins new episodes in some of the mazes.

        Args:
            which: ``[n]``, True for those mazes.
            randoms: n sources of randomness; only theirs are drawn from.
            levels: ``[n]``, of which theirs are played; None to draw some.
        """
        mask = torch.from_numpy(which)
        chosen = self.levels.clone()
        chosen[mask] = self._queue.draw(which, randoms) if levels is None else levels[mask]
        self._mazes.set_levels(chosen)
        everything = bool(which.all())
        call = None if everything else TensorDict({"_reset": mask.unsqueeze(-1)}, [self.count])
        fresh = self._mazes.reset(call)
        self._state = fresh if everything else fresh.where(mask, self._state)
        self._over &= ~mask

    def forget(self, which: NDArray[np.bool_]) -> None:
        """Drops the levels that were drawn ahead for some mazes, whose randomness has changed."""
        self._queue.forget(which)

    def step(self, actions: NDArray[Any], idle: NDArray[np.bool_] | None = None) -> Step:
        """Moves every agent.

        Args:
            actions: int ``[n]``, 0 up, 1 down, 2 left, 3 right.
            idle: ``[n]``, True where the step does not count, since a reset follows.

        Raises:
            ValueError: If an action is none of these.
            ResetNeeded: If an episode that is over, and not idle, was not reset.
        """
        actions = self._checked(actions)
        waiting = self._over.numpy() if idle is None else self._over.numpy() & ~idle
        if waiting.any():
            raise ResetNeeded(
                f"the episode is over in {int(waiting.sum())} of {self.count} mazes: call reset()"
            )
        stepped = self._state.set("action", torch.from_numpy(actions))
        after = self._mazes.step(stepped).get("next")
        self._state = after.exclude("reward")  # which a reset does not give
        self._over = after["done"].squeeze(-1)
        return Step(
            self.observe(),
            after["reward"].squeeze(-1).double().numpy(),
            after["terminated"].squeeze(-1).numpy().copy(),
            after["truncated"].squeeze(-1).numpy().copy(),
        )

    def observe(self) -> Observation:
        """The mazes as they are now, arrays ``[n, ...]`` of their own."""
        return {key: self._state[key].numpy().copy() for key in self.observation_space}

    def render(self, mode: str) -> list[Any]:
        """The mazes as they are now: arrays uint8 ``[H', W', 3]``, or texts."""
        pictures = self._mazes.render(mode)
        return [picture.numpy() for picture in pictures] if mode == "rgb_array" else pictures

    def given(self, level: GivenLevel) -> Level:
        """Levels that a user gave, one for all mazes or one for each.

        Args:
            level: A level ``[]`` or ``[n]``, or drawings of them.

        Returns:
            Levels ``[n]``.

        Raises:
            ValueError: If it is not a valid level of the environment's grid, or not n of them.
        """
        if not isinstance(level, Level):
            level = Level.from_text(level)
        validate_levels(level)
        grid = tuple(level.walls.shape[-2:])
        if grid != self.grid:
            raise ValueError(
                "options['level'] must be of the environment's grid "
                f"{self.grid[0]}x{self.grid[1]}, got {grid[0]}x{grid[1]}"
            )
        if level.batch_size not in (torch.Size([]), torch.Size([self.count])):
            raise ValueError(
                f"options['level'] must be one level or one for each of {self.count} mazes, "
                f"got batch shape {list(level.batch_size)}"
            )
        return level.to(torch.device("cpu")).expand(self.count).clone()

    def _checked(self, actions: NDArray[Any]) -> NDArray[np.int64]:
        actions = np.asarray(actions)
        whole = np.issubdtype(actions.dtype, np.integer) and actions.shape == (self.count,)
        if not whole or not ((actions >= 0) & (actions < len(MOVES))).all():
            raise ValueError(
                f"actions must be {self.count} whole numbers from 0 to {len(MOVES) - 1}, "
                f"got {actions.tolist()!r}"
            )
        return actions.astype(np.int64)


class _LevelQueue:
    """Levels drawn ahead for each maze, from its own randomness.

    What a maze plays depends on its own seed and on how many episodes it has begun, on nothing
    else: not on the other mazes, and not on how many there are.

    Args:
        space: What levels are drawn from.
        count: n.
    """

    def __init__(self, space: SpecificationSpace, count: int) -> None:
        self._space = space
        self._levels = space.sample((count, AHEAD), torch.Generator().manual_seed(0))
        self._next = torch.full((count,), AHEAD)  # of each maze's levels; AHEAD: all are used

    def forget(self, which: NDArray[np.bool_]) -> None:
        """Drops the levels of some mazes."""
        self._next[torch.from_numpy(which)] = AHEAD

    def draw(self, which: NDArray[np.bool_], randoms: Sequence[np.random.Generator]) -> Level:
        """Takes the next level of each of m mazes: ``[m]``, in their order."""
        mask = torch.from_numpy(which)
        empty = mask & (self._next == AHEAD)
        if empty.any():
            self._fill(empty.nonzero().squeeze(1), randoms)
        index = mask.nonzero().squeeze(1)
        levels: Level = self._levels[index, self._next[index]]
        self._next[index] += 1
        return levels

    def _fill(self, index: Tensor, randoms: Sequence[np.random.Generator]) -> None:
        generators = [
            torch.Generator().manual_seed(int(randoms[i].integers(2**63))) for i in index.tolist()
        ]
        choices = torch.stack(
            [torch.randint(self._space.size, (AHEAD,), generator=g) for g in generators]
        )
        self._levels[index] = self._space.generate(choices, generators)
        self._next[index] = 0


def _check_whole(name: str, number: object) -> None:
    if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, got {number!r}")


def _several(name: str, values: Any) -> list[Any]:
    """One value or several, as a list."""
    listed = list(values) if isinstance(values, Sequence | np.ndarray) else [values]
    if not listed or any(isinstance(v, str | bool) for v in listed):
        raise ValueError(f"{name} must be one number or several, got {values!r}")
    return listed
