"""Steps batches of mazes as TorchRL environments."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.models import check_torch_defaults, population
from proposer_rl.settings import signed
from proposer_rl.tasks.mazes.drawings import draw_level
from proposer_rl.tasks.mazes.levels import (
    MOVES,
    Level,
    cell_index,
    cell_plane,
    cell_position,
    planes,
    successors,
)

END_KEYS = ("done", "terminated", "truncated")


class LevelEnv(EnvBase):
    """The base of environments of levels with one agent in each; subclasses define its actions.

    A state is the tensordict that is stepped: its entry ``"agent"``, int64 ``[*B, 2]``, is the
    agent's row and column, and ``"step_count"``, int64 ``[*B, 1]``, the steps taken in this
    episode. Every episode begins at the start of the *same* level, also when TorchRL resets
    finished ones by itself; only :meth:`set_levels` changes levels. Nothing is drawn at random.

    Args:
        levels: Levels of any batch shape ``[*B]``; the environment takes over their shape and
            device. They must be valid; check hand-designed ones by
            :func:`~proposer_rl.tasks.mazes.levels.validate_levels`.
        max_steps: Step limit of an episode.

    Attributes:
        success_rule: The entry of a step that tells success, for ``success`` of
            :class:`~proposer_rl.teaching.LevelTransform`.
    """

    success_rule = "terminated"
    _constant: Sequence[str] = ()  # observations that do not change during an episode

    def __init__(self, levels: Level, max_steps: int) -> None:
        check_torch_defaults()
        super().__init__(
            device=levels.walls.device,
            batch_size=levels.batch_size,
            # A start is never a goal. Otherwise TorchRL checks every reset, waiting for the device.
            allow_done_after_reset=True,
        )
        self.max_steps = max_steps
        self._grid = levels.walls.shape[-2:]
        self._next_levels = levels.clone()
        self._waiting = False  # whether a maze may still be playing an older level
        self._agent = levels.start
        self._play(levels)

    @abstractmethod
    def _tabulate(self, levels: Level) -> None:
        """Prepares the tables for steps in new levels."""

    @abstractmethod
    def _first(self) -> dict[str, Tensor]:
        """Returns the first observations of episodes, with ``"agent"``; do not write to them."""

    @property
    def levels(self) -> Level:
        """Returns the levels of the current episodes, ``[*B]``."""
        return self._levels

    def set_levels(self, levels: Level) -> None:
        """Replaces the levels, each from the next reset of its maze on.

        Args:
            levels: Levels of the environment's batch shape and grid.
        """
        self._next_levels.update_(levels)
        self._waiting = True

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Steps as TorchRL does, without its checks of entries that this environment writes."""
        after, given = self._step(tensordict), tensordict.get("next", None)
        if given is not None:  # by the policy, such as what it remembers
            after.update(given.exclude(*after.keys()))
        tensordict.set("next", after)
        return tensordict, self.maybe_reset(self._step_mdp(tensordict))

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sends the agents of finished mazes back to their starts.

        It does the same as TorchRL's method without waiting for a GPU's answer whether there are
        any.
        """
        if self._waiting:
            return super().maybe_reset(tensordict)
        done = tensordict.get("done")  # [*B, 1]
        ended = done.flatten().nonzero().squeeze(1) if population.at_hand(done) else None
        if ended is not None and not len(ended):
            return tensordict
        after = dict(tensordict.items())
        for key, first in self._first().items():
            if key in after and key not in self._constant:
                after[key] = self._begun(first, after[key], done, ended)
        after["step_count"] = after["step_count"] * ~done
        after |= {key: torch.zeros_like(done) for key in END_KEYS}
        self._agent = after["agent"]
        return TensorDict(after, tensordict.batch_size, device=tensordict.device)

    def _begun(self, first: Tensor, standing: Tensor, done: Tensor, ended: Tensor | None) -> Tensor:
        """Returns an entry's values, with first ones where episodes are over."""
        each = first.shape[self.batch_dims :]
        if ended is None:
            return first.where(done.reshape(*self.batch_size, *[1] * len(each)), standing)
        begun = first.reshape(-1, *each).index_select(0, ended)
        return standing.reshape(-1, *each).index_copy(0, ended, begun).view(standing.shape)

    def to(self, device: torch.device | str | int) -> Self:
        """Moves the environment and its levels to a device."""
        super().to(device)
        self._agent = self._agent.to(self.device)
        self._next_levels = self._next_levels.to(self.device)
        self._play(self._levels.to(self.device))
        return self

    def _specify(self, actions: int, **observed: TensorSpec) -> None:
        """Sets the specs, for a number of actions and further observations."""
        batch, (height, width) = self.batch_size, self._grid
        last_cell = torch.tensor([height - 1, width - 1]).expand(*batch, 2)
        self.observation_spec = Composite(
            **observed,
            agent=Bounded(torch.zeros_like(last_cell), last_cell, dtype=torch.int64),
            step_count=Bounded(0, self.max_steps, (*batch, 1), dtype=torch.int64),
            shape=batch,
        ).to(self.device)
        self.action_spec = Categorical(actions, shape=batch, device=self.device)
        self.reward_spec = Unbounded((*batch, 1), device=self.device)
        flag = Binary(1, (*batch, 1), dtype=torch.bool, device=self.device)
        ends = {key: flag.clone() for key in END_KEYS}
        self.done_spec = Composite(ends, shape=batch, device=self.device)

    def _play(self, levels: Level) -> None:
        self._levels = levels
        self._tabulate(levels)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if mask is None else mask.reshape(self.batch_size)
        if mask is None:
            # A recorded graph of a reset takes the levels that are there when it is replayed.
            if self._waiting or not population.at_hand(self._next_levels.walls):
                self._play(self._next_levels.clone())
            self._waiting = False
        elif self._waiting:
            self._play(self._next_levels.where(mask, self._levels))
        start = self._levels.start
        self._agent = start if mask is None else start.where(mask.unsqueeze(-1), self._agent)
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        ends = {key: none.clone() for key in END_KEYS}
        first = {k: x if k in self._constant else x.clone() for k, x in self._first().items()}
        # TorchRL takes these entries only for the mazes that are reset.
        state = {**first, "step_count": none.long(), **ends}
        return TensorDict(state, self.batch_size, device=self.device)

    def _after(self, terminated: Tensor, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Returns the count of steps, and whether the episode has ended, after a step.

        A step that reaches the goal at the limit is terminated and not truncated.
        """
        step_count = tensordict.get("step_count") + 1
        late = step_count >= self.max_steps
        return {
            "step_count": step_count,
            "done": terminated | late,
            "terminated": terminated,
            "truncated": late > terminated,
        }

    def _set_seed(self, seed: int | None) -> None:
        """Does nothing, as nothing is drawn at random."""


@signed
class MazeEnv(LevelEnv):
    """A batch of mazes, one agent in each.

    - Action: int64 ``[*B]``, 0 up, 1 down, 2 left, 3 right. A move into an obstacle or out of the
      grid leaves the agent where it is.
    - Observation: ``"planes"``, float32 ``[*B, 3, H, W]``: obstacles, start, goal (with
      ``observe_agent`` a fourth plane, the agent); ``"agent"``, int64 ``[*B, 2]``: row and column
      of the agent; ``"step_count"``, int64 ``[*B, 1]``: steps taken in this episode.
    - Reward: float32 ``[*B, 1]``, 1 on entering the goal, minus ``step_penalty`` at every step, the
      last one included.
    - End: ``terminated`` on reaching the goal; ``truncated`` when the step limit is reached
      elsewhere. A step that reaches the goal at the limit is terminated and not truncated.
      ``done`` is either.

    Args:
        levels: As in :class:`~proposer_rl.tasks.mazes.maze_env.LevelEnv`.
        max_steps: Step limit of an episode.
        step_penalty: Cost of a step.
        observe_agent: Whether the planes show the agent.

    Example:
        >>> from proposer_rl import Level
        >>> env = MazeEnv(Level.from_text("S.G"))
        >>> state = env.reset()
        >>> for _ in range(2):
        ...     state = env.step(state.set("action", torch.tensor(3)))["next"]
        >>> state["reward"], state["terminated"]
        (tensor([0.9900]), tensor([True]))
    """

    def __init__(
        self,
        levels: Level,
        *,
        max_steps: int = 25,
        step_penalty: float = 0.01,
        observe_agent: bool = False,
    ) -> None:
        self.step_penalty = step_penalty
        self.observe_agent = observe_agent
        self._constant = () if observe_agent else ("planes",)
        super().__init__(levels, max_steps)
        shape = (*self.batch_size, 3 + observe_agent, *self._grid)
        self._specify(actions=len(MOVES), planes=Bounded(0.0, 1.0, shape))

    def render(self, mode: str = "rgb_array", cell: int = 16) -> Any:
        """Draws the mazes as they are now.

        Args:
            mode: ``"rgb_array"`` or ``"ansi"``.
            cell: Side of a cell in pixels.

        Returns:
            uint8 ``[*B, H', W', 3]``; or a text, for a batch a list of texts, in which ``A`` is the
            agent.
        """
        levels, agents = self._levels.reshape(-1), self._agent.reshape(-1, 2)
        if mode == "ansi":
            places = cell_index(agents, self._grid[1] + 1).tolist()  # with the newlines
            texts = zip(levels.to_text(), places, strict=True)
            marked = [f"{text[:place]}A{text[place + 1 :]}" for text, place in texts]
            return marked if self.batch_dims else marked[0]
        pictures = [
            draw_level(level, agent=agent.tolist(), cell=cell)
            for level, agent in zip(levels, agents, strict=True)
        ]
        return torch.stack(pictures).reshape(*self.batch_size, *pictures[0].shape)

    def _tabulate(self, levels: Level) -> None:
        self._planes = planes(levels)
        self._successors = successors(levels).flatten(-2)  # [*B, 4 * H*W]
        self._goal = cell_index(levels.goal, self._grid[1]).unsqueeze(-1)  # [*B, 1]

    def _first(self) -> dict[str, Tensor]:
        return self._observe(self._levels.start)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        (height, width), action = self._grid, tensordict.get("action")
        cell = cell_index(tensordict.get("agent"), width)
        move = (action * (height * width) + cell).unsqueeze(-1)
        cell = self._successors.gather(-1, move)  # [*B, 1]
        terminated = cell == self._goal
        self._agent = cell_position(cell.squeeze(-1), width)
        reward = terminated.float() - self.step_penalty
        after = {**self._observe(self._agent), **self._after(terminated, tensordict)}
        return TensorDict({**after, "reward": reward}, self.batch_size, device=self.device)

    def _observe(self, agent: Tensor) -> dict[str, Tensor]:
        drawn = self._planes
        if self.observe_agent:
            drawn = torch.cat([drawn, cell_plane(agent, self._grid).unsqueeze(-3)], dim=-3)
        return {"planes": drawn, "agent": agent}
