"""What environments on levels have in common: levels that are replaced, and resets to them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Self

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.models import population
from proposer_rl.tasks.mazes.levels import Level

ENDS = ("done", "terminated", "truncated")


class LevelEnv(EnvBase):
    """A batch of levels, one agent in each; what an agent can do there is a subclass's.

    A state is the tensordict that is stepped: its entry ``"agent"``, int64 ``[*B, 2]``, is the
    agent's row and column, ``"step_count"``, int64 ``[*B, 1]``, the steps taken in this episode.
    An episode begins at the start of the *same* level, also when TorchRL resets finished ones by
    itself. Levels change only by :meth:`set_levels`. Nothing is drawn at random.

    Args:
        levels: Levels of any batch shape ``[*B]``, which with their device become the
            environment's. They must be valid; see
            :func:`~proposer_rl.tasks.mazes.levels.validate_levels` for hand-designed ones.
        max_steps: Step limit of an episode.

    Attributes:
        success_rule: What of a step is a success, as ``success`` of
            :class:`~proposer_rl.teaching.LevelTransform`.

    Raises:
        ValueError: If ``max_steps`` is less than 1.
    """

    success_rule = "terminated"
    _constant: Sequence[str] = ()  # observations that stay the same throughout an episode

    def __init__(self, levels: Level, max_steps: int) -> None:
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}")
        super().__init__(
            device=levels.walls.device,
            batch_size=levels.batch_size,
            # A start is never a goal. Else TorchRL checks every reset, and waits for the device.
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
        """Tabulates what a step needs of levels that are taken up."""

    @abstractmethod
    def _first(self) -> dict[str, Tensor]:
        """What is observed when an episode begins, ``"agent"`` included; nobody writes into it."""

    @property
    def levels(self) -> Level:
        """The levels that are being played, ``[*B]``."""
        return self._levels

    def set_levels(self, levels: Level) -> None:
        """Replaces the levels; each maze plays its new one from its own next reset on.

        Args:
            levels: Levels of the environment's batch shape, grid and device.

        Raises:
            ValueError: If they differ in batch shape, grid or device.
        """
        given = (levels.batch_size, levels.walls.shape[-2:], levels.walls.device)
        own = (self.batch_size, self._grid, self._levels.walls.device)
        if given != own:
            raise ValueError(
                "levels must keep the environment's batch shape, grid and device "
                f"{_describe(*own)}, got {_describe(*given)}"
            )
        self._next_levels.update_(levels)
        self._waiting = True

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """As TorchRL's, without its checks of what this environment has written itself."""
        after, given = self._step(tensordict), tensordict.get("next", None)
        if given is not None:  # by the policy, such as what it remembers
            after.update(given.exclude(*after.keys()))
        tensordict.set("next", after)
        return tensordict, self.maybe_reset(self._step_mdp(tensordict))

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sends the agents of finished mazes back to their starts.

        As TorchRL's, but without asking a GPU first whether there are any, which would have to be
        waited for.
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
        after |= {key: torch.zeros_like(done) for key in ENDS}
        self._agent = after["agent"]
        return TensorDict(after, tensordict.batch_size, device=tensordict.device)

    def _begun(self, first: Tensor, standing: Tensor, done: Tensor, ended: Tensor | None) -> Tensor:
        """What stands in mazes, as at first where they are done."""
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
        """Make the specifications: of one of so many actions, and of what else is observed."""
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
        ends = {key: flag.clone() for key in ENDS}
        self.done_spec = Composite(ends, shape=batch, device=self.device)

    def _play(self, levels: Level) -> None:
        self._levels = levels
        self._tabulate(levels)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if mask is None else mask.reshape(self.batch_size)
        if mask is None:
            # A graph of a reset takes up what is there when it is replayed.
            if self._waiting or not population.at_hand(self._next_levels.walls):
                self._play(self._next_levels.clone())
            self._waiting = False
        elif self._waiting:
            self._play(self._next_levels.where(mask, self._levels))
        start = self._levels.start
        self._agent = start if mask is None else start.where(mask.unsqueeze(-1), self._agent)
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        ends = {key: none.clone() for key in ENDS}
        first = {k: x if k in self._constant else x.clone() for k, x in self._first().items()}
        # Of these TorchRL takes over only the entries of the mazes that are reset.
        state = {**first, "step_count": none.long(), **ends}
        return TensorDict(state, self.batch_size, device=self.device)

    def _after(self, terminated: Tensor, tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Count of the steps, and whether the episode has ended, after a step.

        A step that reaches the goal at the limit is terminated and not truncated, since nothing was
        cut off.
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
        """Does nothing: the environment draws nothing at random."""


def _describe(batch: torch.Size, grid: torch.Size, device: torch.device) -> str:
    return f"{list(batch)}, {grid[0]}x{grid[1]}, {device}"
