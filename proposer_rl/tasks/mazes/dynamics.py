"""How an agent moves in a maze, as a table, and the shortest way through one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from proposer_rl.tasks.mazes.levels import Level

MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Change of row and column by action 0 up, 1 down, 2 left, 3 right."""


def successors(level: Level) -> Tensor:
    """Tabulates where each action leads from each cell.

    A move into an obstacle or out of the grid leads to the cell itself.

    Args:
        level: Levels of batch shape ``[*B]``.

    Returns:
        int64 ``[*B, 4, H*W]``, numbers of cells (row * W + column) by action and cell.
    """
    walls = level.walls
    height, width = walls.shape[-2:]
    cell = torch.arange(height * width, device=walls.device).view(height, width)
    blocked = pad(walls, (1, 1, 1, 1), value=True)  # [*B, H+2, W+2]
    table = [
        torch.where(
            blocked[..., 1 + down : 1 + down + height, 1 + right : 1 + right + width],
            cell,
            cell + (down * width + right),
        )
        for down, right in MOVES
    ]
    return torch.stack(table, dim=-3).flatten(-2)


def shortest_way(
    following: Sequence[Sequence[int]], start: int, arrived: Callable[[int], bool]
) -> list[int] | None:
    """The nodes of a way of fewest actions, the first and the last included.

    Args:
        following: where each action leads from each node.
        start: the first node.
        arrived: whether a node is a last one.

    Returns:
        Of several the one whose actions come first; None where there is none.
    """
    before, waiting = {start: start}, deque([start])
    while waiting:
        node = waiting.popleft()
        if arrived(node):
            way = [node]
            while way[-1] != start:
                way.append(before[way[-1]])
            return way[::-1]
        for action in following:
            if action[node] not in before:
                before[action[node]] = node
                waiting.append(action[node])
    return None
