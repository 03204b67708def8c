"""Steps partially observable mazes in TorchRL, and plays Solvers with memory in them."""

from __future__ import annotations

from functools import cache
from typing import Annotated

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import pad
from torchrl.data import Binary, Bounded, Categorical

from proposer_rl.learning import play_episodes
from proposer_rl.models import ActorCritic, MemoryNetwork
from proposer_rl.settings import settings, signed
from proposer_rl.tasks.mazes.levels import STEPS_BETWEEN_CHECKS, cell_index, cell_plane
from proposer_rl.tasks.mazes.maze_env import LevelEnv
from proposer_rl.tasks.view_mazes.view_levels import AHEAD, ViewLevel

VIEW_ACTIONS = 3
LEFT, RIGHT, FORWARD = range(VIEW_ACTIONS)

EMPTY_OBJECT, WALL_OBJECT, GOAL_OBJECT = 1, 2, 8  # MiniGrid's numbers
VIEW = 5  # cells on a side of what is seen
RIM = VIEW - 1  # of walls around the grid, so that every view is within it
AGENT_PLACE = (VIEW // 2, VIEW - 1)  # of the agent in its view
PENALTY = 0.9  # lost from the reward at the step limit


@signed
class ViewMazeEnv(LevelEnv):
    """A batch of the partially observable mazes of PAIRED, PLR, ACCEL, SFL and their libraries.

    - Action: int64 ``[*B]``, 0 turn left, 1 turn right, 2 move forward. A move into an obstacle or
      out of the grid leaves the agent where it is.
    - Observation: ``"view"``, uint8 ``[*B, 5, 5]``, and ``"direction"``, int64 ``[*B]``, 0 right, 1
      down, 2 left, 3 up. The view shows the cells in front of the agent: 1 empty, 2 wall, 8 goal,
      as MiniGrid's ``image[:, :, 0]`` with ``agent_view_size=5`` and ``see_through_walls=True``, as
      in PLR, ACCEL and SFL. The first index runs from the agent's left to its right, the second
      from far to near; the agent at ``[2, 4]`` is not shown. Walls hide nothing, and outside of the
      grid there are walls.
    - Further state: ``"agent"``, ``"step_count"``, and ``"is_init"``, bool ``[*B, 1]``, whether an
      episode begins.
    - Reward: float32 ``[*B, 1]``, 1 - 0.9 t / ``max_steps`` on entering the goal with step t, else
      0.
    - End: ``terminated`` on reaching the goal; ``truncated`` when the step limit is reached
      elsewhere.

    Args:
        levels: As in :class:`~proposer_rl.tasks.mazes.maze_env.LevelEnv`.
        max_steps: Step limit of an episode.

    Example:
        >>> env = ViewMazeEnv(ViewLevel.from_text("^.G"))
        >>> state = env.reset()
        >>> for action in (1, 2, 2):  # right, forward, forward
        ...     state = env.step(state.set("action", torch.tensor(action)))["next"]
        >>> state["reward"], state["terminated"]
        (tensor([0.9892]), tensor([True]))
    """

    def __init__(self, levels: ViewLevel, *, max_steps: int = 250) -> None:
        super().__init__(levels, max_steps)
        batch = self.batch_size
        self._specify(
            actions=VIEW_ACTIONS,
            view=Bounded(EMPTY_OBJECT, GOAL_OBJECT, (*batch, VIEW, VIEW), dtype=torch.uint8),
            direction=Categorical(len(AHEAD), shape=batch),
            is_init=Binary(1, (*batch, 1), dtype=torch.bool),
        )

    def _tabulate(self, levels: ViewLevel) -> None:
        """Lays all grids with their rims out as one line of objects.

        A place is the number of a cell in that line.
        """
        device, count = self.device, self.batch_size.numel()
        rows, width = (side + 2 * RIM for side in self._grid)
        self._width = width
        walls = pad(levels.walls, (RIM,) * 4, value=True).reshape(count, rows * width)
        objects = torch.where(walls, WALL_OBJECT, EMPTY_OBJECT).to(torch.uint8)
        goal = cell_index(levels.goal + RIM, width).reshape(count, 1)
        self._objects = objects.scatter_(1, goal, GOAL_OBJECT).flatten()
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
        does = does.add_(there == WALL_OBJECT, alpha=len(self._ahead))
        does = self._meaning.index_select(0, does.flatten()).view(*does.shape, 4)
        direction, place = does[..., 0], place + does[..., 1]
        terminated = (there == GOAL_OBJECT).unsqueeze(-1)
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
        view[..., AGENT_PLACE[0], AGENT_PLACE[1]].fill_(EMPTY_OBJECT)
        return view


@cache
def _directions(width: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Tabulates the effects of actions and directions in a line of grids of some width.

    Tables are made once, since a recorded reset must not read numbers of the host.

    Returns:
        For each action in each direction, first if nothing is in the way and then if a wall is,
        int64 [2 * 3 * 4, 4]: the direction after it, the change of place, and the move. The changes
        of place alone if nothing is in the way, [3 * 4]. And the changes of place from the agent to
        the cells in its view for each direction, int32 [4, 25].
    """
    ahead, none = torch.tensor(AHEAD), torch.zeros(len(AHEAD), 2, dtype=torch.int64)
    each = torch.arange(len(AHEAD))
    turned = torch.stack([(each - 1) % len(AHEAD), (each + 1) % len(AHEAD), each], 1)
    moves = torch.stack([none, none, ahead], 1).flatten(0, 1)
    right = ahead.roll(-1, 0)
    across, along = torch.meshgrid(
        torch.arange(VIEW) - AGENT_PLACE[0], AGENT_PLACE[1] - torch.arange(VIEW), indexing="ij"
    )
    seen = right[:, None, None] * across[..., None] + ahead[:, None, None] * along[..., None]
    free = torch.cat([turned.view(-1, 1), cell_index(moves, width).unsqueeze(1), moves], 1)
    blocked = free * torch.tensor([1, 0, 0, 0])
    changes, meaning = free[:, 1].contiguous(), torch.cat([free, blocked])
    # int32 is half the memory to read.
    seen = cell_index(seen, width).flatten(1).int()
    return meaning.to(device), changes.to(device), seen.to(device)


@settings
class ViewNetworkSettings:
    """Settings of the Solver's network.

    Attributes:
        channels: of the convolution.
        direction: features of the direction.
        memory: width of the LSTM.
        head: width of the hidden layer of actor and critic.
    """

    channels: Annotated[int, Ge(1)] = 16
    direction: Annotated[int, Ge(1)] = 5
    memory: Annotated[int, Ge(1)] = 256
    head: Annotated[int, Ge(1)] = 32


VIEW_ENTRIES = ("view", "direction")
SCALE = 10  # by which the field divides MiniGrid's numbers
GREY_COLOUR, GREEN_COLOUR = 5, 1  # MiniGrid's colours of walls and goal


class ViewEncoder(nn.Module):
    """Makes features of views and directions.

    The convolution gets MiniGrid's numbers of objects and of their colours, divided by ten as in
    the field. The third number, a door's state, is zero everywhere and left out.

    Args:
        channels: of the convolution.
        direction: features of the direction.

    Attributes:
        features: number of features.
    """

    def __init__(self, channels: int = 16, direction: int = 5) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(2, channels, 3)
        self.direction = nn.Embedding(len(AHEAD), direction)
        nn.init.orthogonal_(self.direction.weight, 2**0.5)
        self.features = channels * (VIEW - 2) ** 2 + direction

    def codes(self, view: Tensor, direction: Tensor) -> Tensor:
        """Returns codes int64 [N] that are equal for equal views and directions."""
        digits = ((view & WALL_OBJECT) >> 1) | ((view & GOAL_OBJECT) >> 2)
        base = 4 ** torch.arange(VIEW**2, device=view.device)
        return (digits.flatten(1) * base).sum(1) * len(AHEAD) + direction

    def forward(self, view: Tensor, direction: Tensor) -> Tensor:
        """Returns features [N, F] of views uint8 [N, 5, 5] and directions int64 [N]."""
        colour = (view == WALL_OBJECT) * GREY_COLOUR + (view == GOAL_OBJECT) * GREEN_COLOUR
        image = torch.stack([view, colour], 1) / SCALE
        seen = torch.relu(self.convolution(image)).flatten(1)
        return torch.cat([seen, self.direction(direction)], 1)


def view_network(settings: ViewNetworkSettings) -> MemoryNetwork:
    """Returns the network of one Solver."""
    encoder = ViewEncoder(settings.channels, settings.direction)
    return MemoryNetwork(
        encoder, encoder.features, VIEW_ACTIONS, memory=settings.memory, head=settings.head
    )


def fewest_actions(levels: ViewLevel) -> Tensor:
    """Returns the number of actions, turns and moves, on a shortest way to the goal.

    The search spreads a frontier over all pairs of a cell and a direction.

    Args:
        levels: Levels ``[*B]``.

    Returns:
        int64 ``[*B]``, -1 where the goal cannot be reached.

    Example:
        A turn and a move, three times:

        >>> fewest_actions(ViewLevel.from_text('''
        ... ^.#
        ... #.G
        ... '''))
        tensor(6)
    """
    flat = levels.reshape(-1)
    count, each = len(flat), torch.arange(len(flat), device=flat.walls.device)
    free = pad(~flat.walls, (1, 1, 1, 1))  # [N, H + 2, W + 2]
    frontier = torch.zeros(len(AHEAD), *free.shape, dtype=torch.bool, device=free.device)
    frontier[flat.direction, each, flat.start[:, 0] + 1, flat.start[:, 1] + 1] = True
    goal = (each, flat.goal[:, 0] + 1, flat.goal[:, 1] + 1)
    reached, actions = frontier.clone(), torch.full((count,), -1, device=free.device)
    for number in range(1, reached[:, :1].numel() + 1):
        moved = [place.roll(ahead, (1, 2)) for place, ahead in zip(frontier, AHEAD, strict=True)]
        frontier = (torch.stack(moved) & free) | frontier.roll(1, 0) | frontier.roll(-1, 0)
        frontier &= ~reached
        reached |= frontier
        arrived = frontier.any(0)[goal] & (actions < 0)
        actions = actions.masked_fill(arrived, number)
        if number % STEPS_BETWEEN_CHECKS == 0 and not bool(
            (frontier.flatten(2).any(2).any(0) & (actions < 0)).any()
        ):
            break
    return actions.reshape(levels.batch_size)


def optimal_view_return(levels: ViewLevel, max_steps: int = 250) -> Tensor:
    """Returns the largest expected return of any policy, which follows a shortest way.

    Args:
        levels: Levels ``[*B]``; the goal need not be reachable.
        max_steps: Step limit of an episode.

    Returns:
        float32 ``[*B]``.
    """
    actions = fewest_actions(levels)
    reached = (actions >= 0) & (actions <= max_steps)
    return (1 - PENALTY / max_steps * actions).where(reached, 0.0)


@torch.no_grad()
def walks(
    agent: ActorCritic, levels: ViewLevel, max_steps: int, noise: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Plays an episode of K Solvers on each level, and returns their paths.

    Args:
        agent: K Solvers.
        levels: Levels ``[N]``.
        max_steps: Step limit T of an episode.
        noise: For sampled actions, float ``[T, N]``, 0 to 1; None for the most probable ones.

    Returns:
        Row, column and direction before every step and at the end, int64 ``[K, N, T + 1, 3]``, and
        the number of steps, int64 ``[K, N]``. Entries after these steps have no meaning.
    """
    every = levels.expand(agent.copies, *levels.batch_size)
    first = torch.cat([every.start, every.direction.unsqueeze(-1)], -1)  # [K, N, 3]
    went = first.unsqueeze(2).repeat(1, 1, max_steps + 1, 1)
    steps = torch.zeros(every.batch_size, dtype=torch.int64, device=first.device)

    def env(place: Tensor) -> ViewMazeEnv:
        return ViewMazeEnv(every[:, place], max_steps=max_steps)

    if not len(levels):  # there is no environment of none
        return went, steps
    begin = env(torch.arange(len(levels), device=first.device))
    for step, (place, state, counts) in enumerate(
        play_episodes(agent, begin, max_steps, noise, env), 1
    ):
        went[:, place, step] = torch.cat([state["agent"], state["direction"].unsqueeze(-1)], -1)
        steps[:, place] += counts
    return went, steps


def visits(agent: ActorCritic, levels: ViewLevel, max_steps: int) -> Tensor:
    """Returns the cells of levels [C] that K Solvers visit by their most probable actions.

    Returns:
        Share of an episode's steps that end in each cell, float32 ``[K, C, H, W]``.
    """
    went, steps = walks(agent, levels, max_steps)
    seen = torch.zeros(*went.shape[:2], *levels.walls.shape[-2:], device=went.device)
    for step, cells in enumerate(went[..., 1:, :2].unbind(2)):
        seen += cell_plane(cells, seen.shape[-2:]) * (step < steps)[..., None, None]
    return seen / steps[..., None, None].clamp(min=1)
