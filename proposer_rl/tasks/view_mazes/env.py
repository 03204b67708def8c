"""The partially observable maze in TorchRL: an agent that turns, moves and sees 5x5 cells."""

from __future__ import annotations

from functools import cache

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.data import Binary, Bounded, Categorical

from proposer_rl.models import own_state
from proposer_rl.settings import signed
from proposer_rl.tasks.mazes.level_env import LevelEnv
from proposer_rl.tasks.mazes.levels import cell_index
from proposer_rl.tasks.view_mazes.levels import AHEAD, ViewLevel

LEFT, RIGHT, FORWARD = range(3)
EMPTY, WALL, GOAL = 1, 2, 8
"""Objects by MiniGrid's numbers."""

VIEW = 5  # cells on a side of what is seen
RIM = VIEW - 1  # of walls around the grid, so that all that is seen is in memory
AGENT = (VIEW // 2, VIEW - 1)  # where the agent is in its view
PENALTY = 0.9  # of the reward, lost by reaching the goal at the step limit


@signed
class ViewMazeEnv(LevelEnv):
    """The maze of PAIRED, PLR, ACCEL, SFL and their libraries; a batch of them.

    - Action: int64 ``[*B]``, 0 turn left, 1 turn right, 2 move forward. A move into an obstacle or
      out of the grid leaves the agent where it is.
    - Observation, what a Solver sees: ``"view"``, uint8 ``[*B, 5, 5]``, and ``"direction"``, int64
      ``[*B]``, 0 right, 1 down, 2 left, 3 up. The view shows the cells before the agent: 1 empty, 2
      wall, 8 goal, as MiniGrid's ``image[:, :, 0]`` with ``agent_view_size=5`` and
      ``see_through_walls=True``, as PLR, ACCEL and SFL have it. The first index runs from the
      agent's left to its right, the second from afar to near; the agent is at ``[2, 4]`` and not
      shown. Walls hide nothing; outside of the grid there are walls.
    - State besides: ``"agent"``, ``"step_count"``, and ``"is_init"``, bool ``[*B, 1]``, whether an
      episode begins, as TorchRL calls it.
    - Reward: float32 ``[*B, 1]``, 1 - 0.9 t / ``max_steps`` on entering the goal with step t, else
      0.
    - End: ``terminated`` on reaching the goal; ``truncated`` when the step limit is reached
      elsewhere.

    Args:
        levels: As of :class:`~proposer_rl.tasks.mazes.level_env.LevelEnv`.
        max_steps: Step limit of an episode.

    Raises:
        ValueError: If ``max_steps`` is less than 1.

    Example:
        >>> env = ViewMazeEnv(ViewLevel.from_text("^.G"))
        >>> state = env.reset()
        >>> for action in (1, 2, 2):  # right, forward, forward
        ...     state = env.step(state.set("action", torch.tensor(action)))["next"]
        >>> state["reward"], state["terminated"]
        (tensor([0.9892]), tensor([True]))
    """

    @own_state()
    def __init__(self, levels: ViewLevel, *, max_steps: int = 250) -> None:
        super().__init__(levels, max_steps)
        batch = self.batch_size
        self._specify(
            actions=FORWARD + 1,
            view=Bounded(EMPTY, GOAL, (*batch, VIEW, VIEW), dtype=torch.uint8),
            direction=Categorical(len(AHEAD), shape=batch),
            is_init=Binary(1, (*batch, 1), dtype=torch.bool),
        )

    def _tabulate(self, levels: ViewLevel) -> None:
        """Takes levels up as one line of objects, of all grids with their rims one after another.

        A place is a number of a cell in that line.
        """
        device, count = self.device, self.batch_size.numel()
        rows, width = (side + 2 * RIM for side in self._grid)
        self._width = width
        walls = pad(levels.walls, (RIM,) * 4, value=True).reshape(count, rows * width)
        objects = torch.where(walls, WALL, EMPTY).to(torch.uint8)
        goal = cell_index(levels.goal + RIM, width).reshape(count, 1)
        self._objects = objects.scatter_(1, goal, GOAL).flatten()
        rim = RIM * (width + 1)  # before the first cell of a grid
        each = torch.arange(count, device=device).view(self.batch_size)
        self._origin = each * (rows * width) + rim
        self._meaning, self._ahead, self._seen = _directions(width, device)
        self._first_view = self._view(self._place(levels.start), levels.direction)

    def _first(self) -> dict[str, Tensor]:
        return {
            "view": self._first_view,
            "direction": self._levels.direction,
            "agent": self._levels.start,
            "is_init": torch.ones(*self.batch_size, 1, dtype=torch.bool, device=self.device),
        }

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        agent, turn = tensordict.get("agent"), len(AHEAD) - 1
        does = torch.add(tensordict.get("action"), tensordict.get("direction"), alpha=turn)
        place = self._place(agent)
        there = self._objects.take(place + self._ahead.take(does))
        does = does.add_(there == WALL, alpha=len(self._ahead))
        does = self._meaning.index_select(0, does.flatten()).view(*does.shape, 4)
        direction, place = does[..., 0], place + does[..., 1]
        terminated = (there == GOAL).unsqueeze(-1)
        self._agent = agent + does[..., 2:]
        ends = self._after(terminated, tensordict)
        reward = (1 - PENALTY / self.max_steps * ends["step_count"].float()) * terminated
        return TensorDict(
            {
                "view": self._view(place, direction),
                "direction": direction.contiguous(),
                "agent": self._agent,
                "is_init": torch.zeros_like(terminated),
                **ends,
                "reward": reward,
            },
            self.batch_size,
            device=self.device,
        )

    def _place(self, agent: Tensor) -> Tensor:
        return cell_index(agent, self._width) + self._origin

    def _view(self, place: Tensor, direction: Tensor) -> Tensor:
        cells = self._seen.index_select(0, direction.flatten())  # [N, 25]
        cells.add_(place.reshape(-1, 1).int())
        view = self._objects.index_select(0, cells.flatten()).view(*place.shape, VIEW, VIEW)
        view[..., AGENT[0], AGENT[1]].fill_(EMPTY)
        return view


@cache
def _directions(width: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """What actions and directions mean in a line of grids of some width.

    Made once: from numbers of the host, which a recorded reset must not ask for.

    Returns:
        Of each action in each direction, first if nothing is in the way and then if there is, int64
        [2 * 3 * 4, 4]: the direction after it, the change of place, and the move; of the former the
        changes of place alone, [3 * 4]; and the changes of place from the agent to the cells that
        it sees, of each direction, int32 [4, 25].
    """
    ahead, none = torch.tensor(AHEAD), torch.zeros(len(AHEAD), 2, dtype=torch.int64)
    each = torch.arange(len(AHEAD))
    turned = torch.stack([(each - 1) % len(AHEAD), (each + 1) % len(AHEAD), each], 1)
    moves = torch.stack([none, none, ahead], 1).flatten(0, 1)
    right = ahead.roll(-1, 0)
    across, along = torch.meshgrid(
        torch.arange(VIEW) - AGENT[0], AGENT[1] - torch.arange(VIEW), indexing="ij"
    )
    seen = right[:, None, None] * across[..., None] + ahead[:, None, None] * along[..., None]
    free = torch.cat([turned.view(-1, 1), cell_index(moves, width).unsqueeze(1), moves], 1)
    blocked = free * torch.tensor([1, 0, 0, 0])
    changes, meaning = free[:, 1].contiguous(), torch.cat([free, blocked])
    # int32: half the memory to go through.
    seen = cell_index(seen, width).flatten(1).int()
    return meaning.to(device), changes.to(device), seen.to(device)
