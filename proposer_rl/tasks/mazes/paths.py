"""How an agent moves in a maze, and the shortest paths there: of one maze, and of batches.

A batch is searched by spreading a frontier over all of its mazes at once. For that, grids are laid
out *cells first*, ``[H, W, N]``: one shift of the grid is then a view whose rows are N contiguous
entries, so each step costs a few vectorised passes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import pad

from proposer_rl.tasks.mazes.levels import Level, cell_index

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
    """Returns the nodes of a path of fewest actions, the first and the last included.

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


STEPS_BETWEEN_CHECKS = 8  # asking whether the frontier is empty waits for the device


def shortest_path_length(level: Level) -> Tensor:
    """Moves on the shortest path from start to goal.

    Args:
        level: Levels of batch shape ``[*B]``.

    Returns:
        int64 ``[*B]``, -1 where the goal cannot be reached.

    Example:
        >>> shortest_path_length(Level.from_text('''
        ... S.#
        ... #..
        ... #.G
        ... '''))
        tensor(4)
    """
    height, width = level.walls.shape[-2:]
    start, goal = (cell_index(cell, width).flatten() for cell in (level.start, level.goal))
    frontier, unvisited = _begin(cells_first(~level.walls), start)
    spare = torch.zeros_like(frontier)
    length = torch.where(start == goal, 0, -1)
    goal = padded_index(goal, width).unsqueeze(0)
    for step in range(1, height * width):
        _spread(frontier, spare, unvisited)
        frontier, spare = spare, frontier
        length.masked_fill_(frontier.flatten(0, 1).gather(0, goal).squeeze(0), step)
        if step % STEPS_BETWEEN_CHECKS == 0 and not (frontier.any() and (length < 0).any()):
            break
    return length.reshape(level.batch_size)


def cells_first(grid: Tensor) -> Tensor:
    """Lays ``[*B, H, W]`` out as a contiguous ``[H, W, N]``, N the number of mazes."""
    return grid.reshape(-1, *grid.shape[-2:]).permute(1, 2, 0).contiguous()


def depth_schedule(depth: Tensor) -> list[tuple[int, int]]:
    """Plans a spread in which every maze stops at a depth of its own.

    Mazes are in ascending order of depth, so that those still spreading are a slice.

    Args:
        depth: int64 ``[N]``, ascending, on the CPU.

    Returns:
        For step s = 1, 2, ..., max(depth), a pair (first, end): mazes ``first:`` take part in the
        step, and for ``first:end`` it is the last one.
    """
    steps = torch.arange(1, int(depth[-1]) + 2)
    bounds = torch.searchsorted(depth, steps).tolist()
    return list(pairwise(bounds))


def cells_at_depth(free: Tensor, source: Tensor, depth: Tensor) -> Tensor:
    """Finds the cells at an exact distance from one cell of each maze.

    Args:
        free: bool ``[H, W, N]``.
        source: int64 ``[N]``, the number of a free cell.
        depth: int64 ``[N]``, ascending, at least 1, on the CPU.

    Returns:
        bool ``[H, W, N]``.
    """
    frontier, unvisited = _begin(free, source)
    spare = torch.zeros_like(frontier)
    reached = torch.empty_like(free)
    for first, end in depth_schedule(depth):
        _spread(frontier[..., first:], spare[..., first:], unvisited[..., first:])
        frontier, spare = spare, frontier
        reached[..., first:end] = frontier[1:-1, 1:-1, first:end]
    return reached


def padded_index(cell: Tensor, width: int) -> Tensor:
    """Returns numbers of cells in a grid padded on every side, from those in the grid itself."""
    return (cell // width + 1) * (width + 2) + cell % width + 1


def _begin(free: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the frontier at step 0, ``[H + 2, W + 2, N]`` with an empty rim, and other cells."""
    height, width, count = free.shape
    frontier = free.new_zeros(height + 2, width + 2, count)
    frontier.flatten(0, 1).scatter_(0, padded_index(source, width).unsqueeze(0), True)
    return frontier, free & ~frontier[1:-1, 1:-1]


def _spread(frontier: Tensor, spare: Tensor, unvisited: Tensor) -> None:
    """Writes the next frontier into ``spare`` and takes it out of ``unvisited``."""
    following = spare[1:-1, 1:-1]
    torch.bitwise_or(frontier[:-2, 1:-1], frontier[2:, 1:-1], out=following)
    following |= frontier[1:-1, :-2]
    following |= frontier[1:-1, 2:]
    following &= unvisited
    unvisited ^= following
