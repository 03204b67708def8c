"""The two mechanisms that draw candidates of levels, and the random numbers that they draw from.

``uniform``: obstacles, start and goal are uniform, given the path length. ``path_first``: a path
without shortcuts is carved, then cells around it are opened.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.levels import Level, cell_position
from proposer_rl.tasks.mazes.paths import cells_at_depth, depth_schedule, padded_index

Generators = torch.Generator | None | Sequence[torch.Generator]

_NEVER = 2**31 - 1  # rank of a cell that is not to be opened
_CLOSED = 100  # added to a cell's count of carved neighbours: it can no longer be carved


class Draws:
    """Random matrices with one column for each candidate.

    Each column comes from the generator of the candidate's group, in the order of the group's
    candidates. So a group draws the same numbers whatever the other groups are.

    Args:
        generators: One generator (None for torch's default one), or one for each group.
        group: int64 ``[C]`` on the CPU, the candidates' groups; without effect with one generator.
        device: Where to draw, that of the generators.
    """

    def __init__(self, generators: Generators, group: Tensor, device: torch.device) -> None:
        self.device = device
        self._generators = generators
        self._group = group

    def rand(self, rows: int) -> Tensor:
        """Returns uniform numbers in [0, 1), float32 ``[rows, C]``."""
        return self._columns(lambda n, g: torch.rand(rows, n, generator=g, device=self.device))

    def randint(self, high: int) -> Tensor:
        """Returns uniform whole numbers in 0 ... high - 1, int64 ``[1, C]``."""
        return self._columns(
            lambda n, g: torch.randint(high, (1, n), generator=g, device=self.device)
        )

    def of(self, kept: Tensor) -> Draws:
        """Returns the draws of some candidates, given by their ascending indices, int64 ``[A]``."""
        return Draws(self._generators, self._group[kept.cpu()], self.device)

    def _columns(self, draw: Callable[[int, torch.Generator | None], Tensor]) -> Tensor:
        if not isinstance(self._generators, Sequence):
            return draw(len(self._group), self._generators)
        counts = self._group.bincount(minlength=len(self._generators)).tolist()
        drawn = [draw(n, g) for n, g in zip(counts, self._generators, strict=True)]
        place = self._group.argsort(stable=True).argsort()  # of each candidate among the drawn
        return torch.cat(drawn, 1).index_select(1, place.to(self.device))


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
    """Draws uniform obstacles and a uniform free start.

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


def draw_path_first(
    obstacles: Tensor, path_length: Tensor, height: int, width: int, draws: Draws
) -> tuple[Tensor, Level]:
    """Draws one candidate per entry and keeps those that meet their specification.

    Args and returns are those of :func:`draw_uniform`. A candidate is lost if its path runs into
    a dead end, or if too few cells can be opened without a shortcut.
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
    """Draws random paths of which no two cells touch unless they are consecutive.

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
    for first, end in depth_schedule((path_length - 2).clamp(min=0)):
        here, following = reached[..., first:], spare[1:-1, 1:-1, first:]
        torch.minimum(here[:-2, 1:-1], here[2:, 1:-1], out=following)
        torch.minimum(following, here[1:-1, :-2], out=following)
        torch.minimum(following, here[1:-1, 2:], out=following)
        torch.maximum(following, rank[..., first:], out=following)
        reached, spare = spare, reached
        result[first:end] = reached.flatten(0, 1)[:, first:end].gather(0, goal[:, first:end])[0]
    return result
