"""The maze as a TorchRL environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.mazes.dynamics import MOVES, successors
from proposer_rl.mazes.levels import Level, cell_index, cell_plane, cell_position, planes
from proposer_rl.mazes.rendering import draw_level

ENDS = ("done", "terminated", "truncated")


class MazeEnv(EnvBase):
    """A batch of mazes, one agent in each.

    - Action: int64 ``[*B]``, 0 up, 1 down, 2 left, 3 right. A move into an obstacle or out of the
      grid leaves the agent where it is.
    - Observation: ``"planes"``, float32 ``[*B, 3, H, W]``: obstacles, start, goal (with
      ``observe_agent`` a fourth plane, the agent); ``"agent"``, int64 ``[*B, 2]``: row and column
      of the agent; ``"step_count"``, int64 ``[*B, 1]``: steps taken in this episode.
    - Reward: float32 ``[*B, 1]``, 1 on entering the goal, minus ``step_penalty`` at every step, the
      last one included.
    - End: ``terminated`` on reaching the goal; ``truncated`` when the step limit is reached
      elsewhere. A step that reaches the goal at the limit is terminated and not truncated, since
      nothing was cut off. ``done`` is either.
    - Reset: the agent goes back to the start of the *same* level, also when TorchRL resets finished
      mazes by itself. Levels change only by :meth:`set_levels`.

    The dynamics are deterministic and depend on the tensordict that is stepped and on the levels
    alone; nothing is drawn at random.

    Args:
        levels: Levels of any batch shape ``[*B]``, which with their device become the
            environment's. They must be valid; see
            :func:`~proposer_rl.mazes.levels.validate_levels` for hand-made ones.
        max_steps: Step limit of an episode.
        step_penalty: Cost of a step.
        observe_agent: Whether the planes show the agent.

    Raises:
        ValueError: If ``max_steps`` is less than 1.

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
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, got {max_steps}")
        super().__init__(
            device=levels.walls.device,
            batch_size=levels.batch_size,
            # A start is never a goal. Else TorchRL looks at every reset, and waits for the device.
            allow_done_after_reset=True,
        )
        self.max_steps = max_steps
        self.step_penalty = step_penalty
        self.observe_agent = observe_agent
        self._grid = levels.walls.shape[-2:]
        self._make_specs()
        self._next_levels = levels.clone()
        self._waiting = False  # whether a maze may still be playing an older level
        self._play(levels)
        self._agent = levels.start

    @property
    def levels(self) -> Level:
        """The levels that are being played, ``[*B]``."""
        return self._levels

    def set_levels(self, levels: Level) -> None:
        """Replaces the levels; each maze plays its new one from its own next reset on.

        The new levels are copied to where the ones before them were, so that a recorded reset
        (:mod:`proposer_rl.learning.cuda_graphs`) finds them.

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

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sends the agents of finished mazes back to their starts.

        As TorchRL's, but without asking first whether there are any, which would wait for the
        device.
        """
        if self._waiting:
            return super().maybe_reset(tensordict)
        done = tensordict.get("done")  # [*B, 1]
        agent = self._levels.start.where(done, tensordict.get("agent"))
        self._agent = agent
        after = tensordict.copy()
        after.set("agent", agent)
        after.set("step_count", tensordict.get("step_count") * ~done)
        for key in ENDS:
            after.set(key, torch.zeros_like(done))
        if self.observe_agent and "planes" in tensordict.keys():
            after.set("planes", self._observe(agent)["planes"])
        return after

    def to(self, device: torch.device | str | int) -> MazeEnv:
        """Moves the environment and its levels to a device."""
        super().to(device)
        self._agent = self._agent.to(self.device)
        self._next_levels = self._next_levels.to(self.device)
        self._play(self._levels.to(self.device))
        return self

    def render(self, mode: str = "rgb_array", cell: int = 16) -> Any:
        """Draws the mazes as they are now.

        Args:
            mode: ``"rgb_array"`` or ``"ansi"``.
            cell: Side of a cell in pixels.

        Returns:
            uint8 ``[*B, H', W', 3]``; or text (a list of texts for a batch) in which ``A`` is the
            agent.

        Raises:
            ValueError: If the mode is another.
        """
        if mode not in ("rgb_array", "ansi"):
            raise ValueError(f"mode must be 'rgb_array' or 'ansi', got {mode!r}")
        levels, agents = self._levels.reshape(-1), self._agent.reshape(-1, 2)
        if mode == "ansi":
            places = cell_index(agents, self._grid[1] + 1).tolist()  # a line ends by a character
            texts = zip(levels.to_text(), places, strict=True)
            marked = [f"{text[:place]}A{text[place + 1 :]}" for text, place in texts]
            return marked if self.batch_dims else marked[0]
        pictures = [
            draw_level(level, agent=agent.tolist(), cell=cell)
            for level, agent in zip(levels, agents, strict=True)
        ]
        return torch.stack(pictures).reshape(*self.batch_size, *pictures[0].shape)

    def _make_specs(self) -> None:
        batch, (height, width) = self.batch_size, self._grid
        last_cell = torch.tensor([height - 1, width - 1]).expand(*batch, 2)
        self.observation_spec = Composite(
            planes=Bounded(0.0, 1.0, (*batch, 3 + self.observe_agent, height, width)),
            agent=Bounded(torch.zeros_like(last_cell), last_cell, dtype=torch.int64),
            step_count=Bounded(0, self.max_steps, (*batch, 1), dtype=torch.int64),
            shape=batch,
        ).to(self.device)
        self.action_spec = Categorical(len(MOVES), shape=batch, device=self.device)
        self.reward_spec = Unbounded((*batch, 1), device=self.device)
        flag = Binary(1, (*batch, 1), dtype=torch.bool, device=self.device)
        ends = {key: flag.clone() for key in ENDS}
        self.done_spec = Composite(ends, shape=batch, device=self.device)

    def _play(self, levels: Level) -> None:
        """Takes levels up and tabulates what a step needs of them."""
        self._levels = levels
        self._planes = planes(levels)
        self._successors = successors(levels).flatten(-2)  # [*B, 4 * H*W]
        self._goal = cell_index(levels.goal, self._grid[1]).unsqueeze(-1)  # [*B, 1]

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if mask is None else mask.reshape(self.batch_size)
        if mask is None:
            self._play(self._next_levels.clone())
            self._waiting = False
        elif self._waiting:
            self._play(self._next_levels.where(mask, self._levels))
        start = self._levels.start
        self._agent = start if mask is None else start.where(mask.unsqueeze(-1), self._agent)
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        ends = {key: none.clone() for key in ENDS}
        # Of these TorchRL takes over only the entries of the mazes that are reset.
        state = {**self._observe(start.clone()), "step_count": none.long(), **ends}
        return TensorDict(state, self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        (height, width), action = self._grid, tensordict.get("action")
        cell = cell_index(tensordict.get("agent"), width)
        move = (action * (height * width) + cell).unsqueeze(-1)
        cell = self._successors.gather(-1, move)  # [*B, 1]
        step_count = tensordict.get("step_count") + 1
        terminated = cell == self._goal
        truncated = (step_count >= self.max_steps) & ~terminated
        self._agent = cell_position(cell.squeeze(-1), width)
        return TensorDict(
            {
                **self._observe(self._agent),
                "step_count": step_count,
                "reward": terminated.float() - self.step_penalty,
                "done": terminated | truncated,
                "terminated": terminated,
                "truncated": truncated,
            },
            self.batch_size,
            device=self.device,
        )

    def _observe(self, agent: Tensor) -> dict[str, Tensor]:
        drawn = self._planes
        if self.observe_agent:
            drawn = torch.cat([drawn, cell_plane(agent, self._grid).unsqueeze(-3)], dim=-3)
        return {"planes": drawn, "agent": agent}

    def _set_seed(self, seed: int | None) -> None:
        """Does nothing: the environment draws nothing at random."""


def _describe(batch: torch.Size, grid: torch.Size, device: torch.device) -> str:
    return f"{list(batch)}, {grid[0]}x{grid[1]}, {device}"
