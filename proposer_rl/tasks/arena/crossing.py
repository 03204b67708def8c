"""MiniGrid's SimpleCrossing: walls across a room, each with an opening, before the goal."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.arena.doorkey import (
    EMPTY,
    FORWARD,
    GOAL,
    LEFT,
    RIGHT,
    UNSEEN,
    VIEW,
    WALL,
    aside,
    cells_in_view,
    seen,
)
from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values

WALLS = 4  # that fit side by side into the largest room, of 11 by 11 cells
NONE = 2.0  # more than any number that is drawn


class CrossingEnv(BatchedEnv):
    """MiniGrid's SimpleCrossing (Chevalier-Boisvert et al. 2023, NeurIPS), a batch of them at once.

    The level's ``size`` is MiniGrid's, walls included, an odd number up to 11; so many of the
    ``walls`` are built as there is room for. Maps are drawn as MiniGrid does: walls from side to
    side, every second row and column at most, each with one opening on a way from the upper left
    to the goal in the lower right. Actions, rewards and the view of 7 by 7 cells are MiniGrid's.
    """

    # Openings of vertical walls in columns 2, 4, 6, 8 and of horizontal ones in these rows, 0 where
    # there is no wall; column, row, direction, steps.
    state_size = 2 * WALLS + 4
    observation_size = 3 * VIEW**2
    actions = 7
    draws = 6 * WALLS

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 12]: a map, seen from its upper left corner."""
        size = level["size"].unsqueeze(-1)
        order, turns, places = chance.unflatten(-1, (3, 2, WALLS)).unbind(-3)
        lines = torch.arange(2, 2 * WALLS + 1, 2, device=chance.device)
        order = order.where((lines < size - 2).unsqueeze(-2), NONE).flatten(-2)
        rank = order.argsort(-1).argsort(-1)
        built = ((rank < level["walls"].unsqueeze(-1)) & (order < NONE)).unflatten(-1, (2, WALLS))
        # A way to the goal crosses the vertical walls from left to right and the horizontal ones
        # from above, both in turn: the earlier, the lower their numbers are.
        turns = turns.where(built, NONE).sort(-1).values
        turns = turns.gather(-1, (built.cumsum(-1) - 1).clamp(min=0)).where(built, NONE)
        crossed, between = turns.flip(-2).unsqueeze(-2), turns.unsqueeze(-1)
        room = (crossed < between).sum(-1)  # between which walls of the other kind it is then
        last = (size - 1).unsqueeze(-2).expand(*built.shape[:-1], 1)
        walls = torch.cat([lines.where(built.flip(-2), last).sort(-1).values, last], -1)
        start = torch.cat([torch.zeros_like(last), walls], -1).gather(-1, room)
        wide = walls.gather(-1, room) - start - 1
        openings = (start + 1 + (places * wide).floor()) * built
        begun = openings.new_tensor([1, 1, 0, 0]).expand(*size.shape[:-1], 4)
        return torch.cat([openings.flatten(-2), begun], -1).float()

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the agent turns, or goes forward where there is no wall."""
        x, y, way, steps = state[..., 2 * WALLS :].unbind(-1)
        to_x, to_y = x + aside(way + 1), y + aside(way)
        walls, goal = _things(state, level, to_x, to_y)
        walked, steps = (action == FORWARD) & ~walls, steps + 1
        there = walked & goal
        following = [
            torch.where(walked, to_x, x),
            torch.where(walked, to_y, y),
            (way + (action == RIGHT).float() - (action == LEFT).float()) % 4,
            steps,
        ]
        reward = there * (1 - 0.9 * steps / self.max_steps)
        state = torch.cat([state[..., : 2 * WALLS], torch.stack(following, -1)], -1)
        return Step(state, reward, there, there)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns MiniGrid's numbers of what is seen ahead, from far to near and left to right."""
        to_x, to_y, here = cells_in_view(*state[..., 2 * WALLS : -1].unbind(-1))
        walls, goal = _things(state, level, to_x, to_y)
        kind = torch.where(here, 1, 1 + walls * 1 + goal * 2)
        looks = state.new_tensor([UNSEEN, EMPTY, WALL, GOAL])
        return looks[kind * seen(~walls | here)].flatten(-3)


def _things(state: Tensor, level: Values, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Returns whether a wall, and the goal, is in each of the cells [*B, ...]."""
    inner = (1,) * (x.dim() - state.dim() + 1)
    last = level["size"].reshape(level["size"].shape + inner) - 1
    walls = (x <= 0) | (y <= 0) | (x >= last) | (y >= last)
    for number, opening in enumerate(state[..., : 2 * WALLS].unbind(-1)):
        opening = opening.reshape(opening.shape + inner)
        along, across = (y, x) if number < WALLS else (x, y)
        line = 2 * (number % WALLS) + 2
        walls = walls | ((across == line) & (along != opening) & (opening > 0))
    return walls, (x == last - 1) & (y == last - 1)
