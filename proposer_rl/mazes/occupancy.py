"""Where a policy gets from every cell of a maze, and where it spends its time, exactly.

A maze with a policy per cell is a Markov chain over its cells in which the goal absorbs;
:class:`~proposer_rl.mazes.evaluation.ExactEvaluator` asks it for one number, these two for a map.
"""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.mazes.dynamics import successors
from proposer_rl.mazes.levels import Level, cell_index, cell_plane


def success_from_cells(level: Level, policy: Tensor, max_steps: int) -> Tensor:
    """Probability of reaching the goal from every cell, each with the whole step limit.

    Args:
        level: A level of batch shape ``[]``.
        policy: Action probabilities, float ``[4, H, W]``.
        max_steps: Step limit of an episode.

    Returns:
        float ``[H, W]``, 1 at the goal. What it says of an obstacle has no meaning.

    Example:
        Uniformly random moves in a corridor, two steps:

        >>> level = Level.from_text("S.G")
        >>> success_from_cells(level, torch.full((4, 1, 3), 0.25), max_steps=2)
        tensor([[0.0625, 0.3750, 1.0000]])
    """
    goal = cell_plane(level.goal, level.walls.shape)
    following = successors(level)  # [4, H*W]
    chosen, reached = policy.flatten(1), goal.flatten()
    for _ in range(max_steps):
        after = (chosen * reached[following]).sum(0)
        reached = after.where(goal.flatten() == 0, goal.flatten())
    return reached.view_as(goal)


def expected_visits(level: Level, policy: Tensor, max_steps: int) -> Tensor:
    """Expected number of steps that an episode begins at every cell.

    Args:
        level: A level of batch shape ``[]``.
        policy: Action probabilities, float ``[4, H, W]``.
        max_steps: Step limit of an episode.

    Returns:
        float ``[H, W]``, 0 at the goal, where no step is taken; their sum is the expected length of
        an episode.

    Example:
        >>> level = Level.from_text("S.G")
        >>> expected_visits(level, torch.full((4, 1, 3), 0.25), max_steps=2)
        tensor([[1.7500, 0.2500, 0.0000]])
    """
    here = cell_plane(level.start, level.walls.shape)
    grid, visits = here.shape, torch.zeros_like(here).flatten()
    following, chosen = successors(level).flatten(), policy.flatten(1)
    here, goal = here.flatten(), int(cell_index(level.goal, grid[1]))
    for _ in range(max_steps):
        visits += here
        here = torch.zeros_like(here).index_add_(0, following, (chosen * here).flatten())
        here[goal] = 0
    return visits.view(grid)
