"""The maze as a TorchRL environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded

from proposer_rl.models import own_state
from proposer_rl.settings import signed
from proposer_rl.tasks.mazes.dynamics import MOVES, successors
from proposer_rl.tasks.mazes.level_env import LevelEnv
from proposer_rl.tasks.mazes.levels import Level, cell_index, cell_plane, cell_position, planes
from proposer_rl.tasks.mazes.rendering import draw_level


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
      elsewhere. A step that reaches the goal at the limit is terminated and not truncated, since
      nothing was cut off. ``done`` is either.

    Args:
        levels: As of :class:`~proposer_rl.tasks.mazes.level_env.LevelEnv`.
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

    @own_state()
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
