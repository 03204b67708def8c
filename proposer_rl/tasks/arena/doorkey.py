"""MiniGrid's DoorKey: a locked door before the goal, and a key on this side of it."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE = range(6)  # and 6, which does nothing
OPEN, CLOSED, LOCKED = range(3)
VIEW = 7
# MiniGrid's numbers of an object, its color and its state; those of doors by their state.
UNSEEN, EMPTY, WALL, KEY, GOAL = (0, 0, 0), (1, 0, 0), (2, 5, 0), (5, 4, 0), (8, 1, 0)
DOORS = [(4, 4, how) for how in (OPEN, CLOSED, LOCKED)]


class DoorkeyEnv(BatchedEnv):
    """MiniGrid's DoorKey (Chevalier-Boisvert et al. 2023, NeurIPS), a batch of them at once.

    The level's ``size`` is MiniGrid's, walls included. Maps are drawn as MiniGrid does: a wall
    splits the room, the agent and the key are on the left of it, and the goal in the lower right
    corner. Actions, rewards and the view of 7 by 7 cells are MiniGrid's, too.
    """

    state_size = 9  # wall, its door and how that is, key or -1, place, way, steps
    observation_size = 3 * VIEW**2
    actions = 7
    draws = 5

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 9]: a map whose door is locked."""
        size, share = level["size"], chance.unbind(-1)
        rows = size - 2
        wall = 2 + (share[0] * (size - 4)).long()
        door = 1 + (share[1] * (size - 3)).long()
        cells = (wall - 1) * rows
        place = (share[2] * cells).long()
        key = (share[3] * (cells - 1)).long()
        key = key + (key >= place)
        inside = [1 + number for cell in (key, place) for number in (cell // rows, cell % rows)]
        way, steps = (4 * share[4]).long(), torch.zeros_like(door)
        return torch.stack([wall, door, steps + LOCKED, *inside, way, steps], -1).float()

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: what the action does to the agent, the key and the door."""
        wall, door, how, key_x, key_y, x, y, way, steps = state.unbind(-1)
        to_x, to_y = x + aside(way + 1), y + aside(way)
        walls, keys, doors, goal = _things(state, level, to_x, to_y)
        free, carried = ~(walls | keys | doors | goal), key_x < 0
        walked = (action == FORWARD) & (free | goal | (doors & (how == OPEN)))
        taken, dropped = (action == PICKUP) & keys, (action == DROP) & free & carried
        turned = (action == TOGGLE) & doors & ((how != LOCKED) | carried)
        there, steps = walked & goal, steps + 1
        following = [
            wall,
            door,
            torch.where(turned, torch.where(how == OPEN, CLOSED, OPEN), how),
            torch.where(taken, -1.0, torch.where(dropped, to_x, key_x)),
            torch.where(taken, -1.0, torch.where(dropped, to_y, key_y)),
            torch.where(walked, to_x, x),
            torch.where(walked, to_y, y),
            (way + (action == RIGHT).float() - (action == LEFT).float()) % 4,
            steps,
        ]
        reward = there * (1 - 0.9 * steps / self.max_steps)
        return Step(torch.stack(following, -1), reward, there, there)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns MiniGrid's numbers of what is seen ahead, from far to near and left to right."""
        to_x, to_y, here = cells_in_view(*state[..., 5:8].unbind(-1))
        walls, keys, doors, goal = _things(state, level, to_x, to_y)
        how, carried = state[..., 2, None, None], state[..., 3, None, None] < 0
        kind = 1 + walls * 1 + keys * 2 + goal * 3 + doors * (4 + how.int())
        kind = torch.where(here, 1 + 2 * carried, kind)
        closed = walls | (doors & (how != OPEN))
        looks = state.new_tensor([UNSEEN, EMPTY, WALL, KEY, GOAL, *DOORS])
        return looks[kind * seen(~closed | here)].flatten(-3)


def cells_in_view(x: Tensor, y: Tensor, way: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns where the cells lie that an agent looks at, and which of them it stands in.

    Args:
        x: column of the agent, float [*B].
        y: its row, likewise.
        way: direction in which it looks, from 0 (right) over 1 (down) to 3 (up), likewise.

    Returns:
        Columns and rows, float [*B, 7, 7], from far to near and left to right, and a mask [7, 7].
    """
    x, y, way = (number[..., None, None] for number in (x, y, way))
    numbers = torch.arange(VIEW, device=x.device)
    forward, right = (VIEW - 1 - numbers).unsqueeze(-1), numbers - VIEW // 2
    to_x = x + forward * aside(way + 1) - right * aside(way)
    to_y = y + forward * aside(way) + right * aside(way + 1)
    return to_x, to_y, (forward == 0) & (right == 0)


def aside(way: Tensor) -> Tensor:
    """Returns how far down a step goes in a direction, 0 (right) to 3 (up); right, in the next."""
    return (way % 2) * (2 - (way % 4))


def _things(
    state: Tensor, level: Values, x: Tensor, y: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns whether a wall, the key, the door and the goal is in each of the cells [*B, ...]."""

    def of(number: Tensor) -> Tensor:
        return number.reshape(number.shape + (1,) * (x.dim() - number.dim()))

    wall, door, _, key_x, key_y, *_ = (of(number) for number in state.unbind(-1))
    last = of(level["size"]) - 1
    doors = (x == wall) & (y == door)
    walls = (x <= 0) | (y <= 0) | (x >= last) | (y >= last) | (x == wall)
    goal = (x == last - 1) & (y == last - 1)
    return walls & ~doors, (x == key_x) & (y == key_y), doors, goal


def seen(clear: Tensor) -> Tensor:
    """Returns what is seen of a view [*B, 7, 7] from its lowest row's middle, as MiniGrid does."""
    bits = 2 ** torch.arange(VIEW, device=clear.device)
    row, rows = 2 ** (VIEW // 2), []
    lit, above = SIGHT.to(clear.device)
    for ahead in reversed((clear * bits).sum(-1).unbind(-1)):
        place = 2**VIEW * row + ahead
        rows.append(lit[place])
        row = above[place]
    return (torch.stack(rows[::-1], -1).unsqueeze(-1) & bits) > 0


def _sight() -> Tensor:
    """Returns what is seen of a row and of the one above: bits [2, 128 * 128].

    Sight goes along a row from clear cell to cell, and from clear cells to the three above. Rows
    are numbers of a bit for each cell, of what is seen from below and of what is clear.
    """
    every = torch.arange(2**VIEW)
    row, clear = every.repeat_interleave(2**VIEW), every.repeat(2**VIEW)
    for _ in range(VIEW - 1):
        row = row | _beside(row & clear)
    above = row & clear
    return torch.stack([row, above | _beside(above)])


def _beside(row: Tensor) -> Tensor:
    return (row << 1 | row >> 1) & (2**VIEW - 1)


SIGHT = _sight()
