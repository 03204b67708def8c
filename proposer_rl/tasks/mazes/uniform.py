"""The ``uniform`` mechanism: obstacles, start and goal uniform, given the path length."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.distance import cells_at_depth
from proposer_rl.tasks.mazes.levels import Level, cell_position
from proposer_rl.tasks.mazes.randomness import Draws


def draw_uniform(
    obstacles: Tensor, path_length: Tensor, height: int, width: int, draws: Draws
) -> tuple[Tensor, Level]:
    """Draws one candidate per entry and keeps those in which the path length occurs.

    A candidate is a uniform pair of obstacles and start. It is kept if some cell lies at exactly
    the distance that is asked for, and the goal is then uniform over such cells.

    Args:
        obstacles: int64 ``[C]`` on the CPU, number of obstacles of each candidate.
        path_length: int64 ``[C]`` on the CPU, ascending.
        height: H.
        width: W.
        draws: Random numbers of the candidates.

    Returns:
        Indices of the A candidates that were kept, int64 ``[A]`` ascending, and their levels.
    """
    walls, start = _draw_walls_and_start(obstacles, height * width, draws)
    free = ~walls.unflatten(0, (height, width))  # [H, W, C]
    goals = cells_at_depth(free, start, path_length).flatten(0, 1)  # [H*W, C]
    kept = goals.any(0).nonzero().squeeze(1)  # [A]
    marked = goals.index_select(1, kept).cumsum(0, dtype=torch.int32)  # up to and with each cell
    # Equal parts of [0, 1) lead to each goal; rounding may make the product their whole number.
    rank = (draws.of(kept).rand(1).squeeze(0) * marked[-1]).int().minimum(marked[-1] - 1)
    goal = (marked <= rank).sum(0)
    return kept, Level(
        walls=walls.index_select(1, kept).t().unflatten(1, (height, width)),
        start=cell_position(start[kept], width),
        goal=cell_position(goal, width),
        batch_size=kept.shape,
    )


def _draw_walls_and_start(obstacles: Tensor, cells: int, draws: Draws) -> tuple[Tensor, Tensor]:
    """Uniform obstacles and a uniform free start.

    The obstacles are drawn by selection sampling (Knuth, The Art of Computer Programming, vol. 2,
    3.4.2, algorithm S): a cell becomes one with probability (obstacles still needed) / (cells still
    left), which gives exactly the number asked for. They are drawn among all cells but the last;
    swapping that free cell with a uniform start cell makes the pair uniform.

    Returns:
        walls, bool ``[H*W, C]``, and start, int64 ``[C]``.
    """
    device, count = draws.device, obstacles.shape[0]
    needed = obstacles.to(device, torch.float32)
    draw = draws.rand(cells - 1)
    # Strictly below the number of cells left, also after rounding: the last ones needed are taken.
    draw *= torch.arange(cells - 1, 0, -1, device=device).unsqueeze(1)
    walls = torch.zeros(cells, count, dtype=torch.bool, device=device)
    for wall, threshold in zip(walls, draw, strict=False):
        torch.lt(threshold, needed, out=wall)
        needed -= wall.float()
    start = draws.randint(cells)
    walls[-1:] = walls.gather(0, start)
    walls.scatter_(0, start, False)
    return walls, start.squeeze(0)
