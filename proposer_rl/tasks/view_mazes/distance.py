"""Fewest actions to the goal, turns included."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from proposer_rl.tasks.mazes.distance import STEPS_BETWEEN_CHECKS
from proposer_rl.tasks.view_mazes.env import PENALTY
from proposer_rl.tasks.view_mazes.levels import AHEAD, ViewLevel


def fewest_actions(levels: ViewLevel) -> Tensor:
    """Actions on a shortest way from the start to the goal: turns to either side, and moves.

    A frontier spreads over all pairs of a cell and a direction at once.

    Args:
        levels: Levels ``[*B]``.

    Returns:
        int64 ``[*B]``, -1 where the goal cannot be reached.

    Example:
        Three times a turn and a move:

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


def optimal_return(levels: ViewLevel, max_steps: int = 250) -> Tensor:
    """The largest expected return of any policy: that of a shortest way, 0 if it is too long.

    Args:
        levels: Levels ``[*B]``; the goal need not be reachable.
        max_steps: Step limit of an episode.

    Returns:
        float32 ``[*B]``.
    """
    actions = fewest_actions(levels)
    reached = (actions >= 0) & (actions <= max_steps)
    return (1 - PENALTY / max_steps * actions).where(reached, 0.0)
