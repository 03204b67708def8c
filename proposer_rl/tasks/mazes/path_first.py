"""The ``path_first`` mechanism: carve a path without shortcuts, then open cells around it."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.distance import padded_index, schedule
from proposer_rl.tasks.mazes.levels import Level, cell_position
from proposer_rl.tasks.mazes.randomness import Draws

_NEVER = 2**31 - 1  # rank of a cell that is not to be opened
_CLOSED = 100  # added to a cell's count of carved neighbours: it can no longer be carved


def draw_path_first(
    obstacles: Tensor, path_length: Tensor, height: int, width: int, draws: Draws
) -> tuple[Tensor, Level]:
    """Draws one candidate per entry and keeps those that meet their specification.

    Args and returns are those of :func:`proposer_rl.tasks.mazes.uniform.draw_uniform`. A candidate
    is
    lost if its path runs into a dead end, or if too few cells can be opened without a shortcut.
    """
    path, carved = _carve(path_length.to(draws.device), height, width, draws)  # [D+1, C], [C]
    kept = carved.nonzero().squeeze(1)  # [A]
    path = path.index_select(1, kept)
    rank = _opening_order(path, height * width, draws.of(kept))  # [H*W, A]
    cells_free = height * width - obstacles[kept.cpu()]
    free, met = _open_cells(
        rank.unflatten(0, (height, width)), path[0], path[-1], path_length[kept.cpu()], cells_free
    )
    return kept[met], Level(
        walls=~free[..., met].permute(2, 0, 1),
        start=cell_position(path[0, met], width),
        goal=cell_position(path[-1, met], width),
        batch_size=met.shape,
    )


def _carve(path_length: Tensor, height: int, width: int, draws: Draws) -> tuple[Tensor, Tensor]:
    """Random paths of which no two cells touch unless they are consecutive.

    A path goes on to a uniform choice among the cells whose only carved neighbour is its end.

    Returns:
        path, int64 ``[D + 1, C]`` with D the longest length: numbers of the cells, the last one
        repeated where a path is shorter; and whether the path reached its length, bool ``[C]``.
    """
    device, count = path_length.device, path_length.shape[0]
    stride = width + 2
    moves = torch.tensor([-stride, stride, -1, 1], device=device).unsqueeze(1)  # [4, 1]
    touched = torch.full((height + 2, stride, count), _CLOSED, dtype=torch.int32, device=device)
    touched[1:-1, 1:-1] = 0
    touched = touched.flatten(0, 1)  # [(H+2) * (W+2), C]
    ones = touched.new_ones(4, count)

    start = draws.randint(height * width)
    cell = padded_index(start, width)  # [1, C]
    path = [cell]
    alive = torch.ones(1, count, dtype=torch.bool, device=device)
    for step in range(int(path_length.max())):
        touched.scatter_add_(0, cell, ones[:1] * _CLOSED)
        neighbours = cell + moves  # [4, C]
        touched.scatter_add_(0, neighbours, ones)
        open_to = touched.gather(0, neighbours) == 1
        rank = draws.rand(4)
        choice = rank.masked_fill_(~open_to, -1.0).argmax(0, keepdim=True)
        going = step < path_length
        alive &= open_to.any(0) | ~going
        cell = torch.where(going & alive, neighbours.gather(0, choice), cell)
        path.append(cell)
    padded = torch.cat(path)
    return (padded // stride - 1) * width + padded % stride - 1, alive.squeeze(0)


def _opening_order(path: Tensor, cells: int, draws: Draws) -> Tensor:
    """Ranks the cells of each maze in a random order of opening, those of its path first.

    From int64 ``[D + 1, N]`` to int32 ``[H*W, N]``, a permutation of 0 ... H*W - 1 in each column.
    """
    order = draws.rand(cells).scatter_(0, path, -1.0).argsort(0)
    ranks = torch.arange(cells, dtype=torch.int32, device=path.device).unsqueeze(1)
    return torch.empty_like(order, dtype=torch.int32).scatter_(0, order, ranks.expand_as(order))


def _open_cells(
    rank: Tensor, start: Tensor, goal: Tensor, path_length: Tensor, cells_free: Tensor
) -> tuple[Tensor, Tensor]:
    """Opens cells in the order of their rank, skipping those that would make a shortcut.

    One cell at a time is not needed: the first cell that would make a shortcut is the one with the
    least rank that *some* shortcut cannot avoid, and all cells before it can be opened. So
    each round skips one cell in every maze in which such a cell comes before the last cell needed.

    Args:
        rank: int32 ``[H, W, N]``; changed in place.
        start: int64 ``[N]``, number of the start cell.
        goal: int64 ``[N]``, number of the goal cell.
        path_length: int64 ``[N]`` on the CPU, ascending.
        cells_free: int64 ``[N]`` on the CPU, cells to be free in the end, path included.

    Returns:
        free, bool ``[H, W, N]``, and the indices of the mazes where enough cells could be opened.
    """
    cells = rank.shape[0] * rank.shape[1]
    free = torch.empty_like(rank, dtype=torch.bool)
    met = torch.zeros_like(start, dtype=torch.bool)
    last = cells_free.to(rank)  # cells of lower rank are open in the end
    active = torch.arange(len(start), device=rank.device)
    while active.numel():
        shortcut = _shortcut_rank(rank, start[active], goal[active], path_length[active.cpu()])
        done = shortcut >= last
        finished = done.nonzero().squeeze(1)
        free[..., active[finished]] = rank[..., finished] < last[finished]
        met[active[finished]] = True
        rank = rank.masked_fill(rank == shortcut, _NEVER)
        last = last + 1
        going = (~done & (last <= cells)).nonzero().squeeze(1)
        active, rank, last = active[going], rank[..., going], last[going]
    return free, met.nonzero().squeeze(1)


def _shortcut_rank(rank: Tensor, start: Tensor, goal: Tensor, path_length: Tensor) -> Tensor:
    """Finds the first cell whose opening, after all those of lower rank, makes a shortcut.

    It is the least, over all walks shorter than the path, of the greatest rank on the walk.
    Lengths of walks between two cells of a grid differ by even numbers and a walk may go to and
    fro, so walks of exactly ``path_length - 2`` moves cover all of them.

    Takes what :func:`_open_cells` does; gives the cell's rank, int32 ``[N]``, or ``_NEVER``.
    """
    height, width, count = rank.shape
    reached = rank.new_full((height + 2, width + 2, count), _NEVER)
    reached.flatten(0, 1).scatter_(0, padded_index(start, width).unsqueeze(0), 0)
    spare = torch.full_like(reached, _NEVER)
    goal = padded_index(goal, width).unsqueeze(0)
    result = torch.full_like(rank[0, 0], _NEVER)
    for first, end in schedule((path_length - 2).clamp(min=0)):
        here, following = reached[..., first:], spare[1:-1, 1:-1, first:]
        torch.minimum(here[:-2, 1:-1], here[2:, 1:-1], out=following)
        torch.minimum(following, here[1:-1, :-2], out=following)
        torch.minimum(following, here[1:-1, 2:], out=following)
        torch.maximum(following, rank[..., first:], out=following)
        reached, spare = spare, reached
        result[first:end] = reached.flatten(0, 1)[:, first:end].gather(0, goal[:, first:end])[0]
    return result
