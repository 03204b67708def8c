"""Draws mazes that meet their specification exactly, from distributions of them, and edits them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any, NamedTuple, NoReturn, TypeVar

import torch
from torch import Tensor

from proposer_rl.models import check_torch_defaults
from proposer_rl.tasks.mazes.levels import (
    Level,
    LevelSpec,
    cell_index,
    cell_position,
    cells_at_depth,
    depth_schedule,
    padded_index,
    shortest_path_length,
)

Generators = torch.Generator | None | Sequence[torch.Generator]


def generate_levels(
    obstacle_fraction: float | Sequence[float] | Tensor,
    path_length: int | Sequence[int] | Tensor,
    height: int = 10,
    width: int = 10,
    mechanism: str = "uniform",
    generator: Generators = None,
    device: torch.device | str | None = None,
) -> Level:
    """Draws one level for each specification, exactly as specified.

    Every level has ``round(obstacle_fraction * H * W)`` obstacles, a free start, a free goal, and a
    shortest path of ``path_length`` moves. The product is rounded in float64, halves to the even
    number; pass the fraction in float64 if a half matters.

    - ``uniform``: obstacles uniform over the cells, start uniform over the free cells, goal uniform
      over the cells at distance ``path_length`` from it; obstacles and start are drawn again
      until there is such a cell.
    - ``path_first``: a random path without shortcuts is carved into solid obstacles from a uniform
      start. Then cells are opened in random order, except those that would shorten the path from
      start to goal, until the number of obstacles is met. The level is drawn again if that fails.

    Args:
        obstacle_fraction: Fractions in [0, 1), broadcast with ``path_length`` to ``[*B]``.
        path_length: Whole numbers of moves, at least 1.
        height: H, cells.
        width: W, cells.
        mechanism: ``"uniform"`` or ``"path_first"``.
        generator: Source of randomness; None for torch's default one. Levels are drawn on its
            device, so that they depend on nothing else. Of a sequence of generators, one for each
            index of the first dimension, generator k draws levels ``[k]``, the same as alone.
        device: Of the returned levels; None for that of ``obstacle_fraction`` or ``path_length``
            if either is a tensor, else that of the generator, else the CPU.

    Returns:
        Levels of batch shape ``[*B]``.

    Raises:
        ValueError: If an argument is invalid; or, naming the specification, if one is impossible or
            so rare that the mechanism did not meet it within a bounded number of candidates.

    Example:
        >>> levels = generate_levels(0.25, [3, 5], height=6, width=6)
        >>> levels.walls.sum((-2, -1))
        tensor([9, 9])
        >>> from proposer_rl.tasks.mazes import shortest_path_length
        >>> shortest_path_length(levels)
        tensor([3, 5])
    """
    check_torch_defaults()
    source = generator[0] if isinstance(generator, Sequence) else generator
    if device is None:
        tensors = [x for x in (obstacle_fraction, path_length) if isinstance(x, Tensor)]
        device = tensors[0].device if tensors else "cpu" if source is None else source.device
    device = torch.device(device)
    fraction, length = _specifications(obstacle_fraction, path_length)
    shape, groups, group = fraction.shape, 1, torch.zeros_like(length)
    if isinstance(generator, Sequence):
        groups = len(generator)
        group += torch.arange(groups).view(-1, *[1] * (len(shape) - 1))
    levels: Any
    if isinstance(generator, Sequence) and not _MECHANISMS[mechanism].pools:
        each = zip(fraction, length, generator, strict=True)
        levels = torch.stack(
            [generate_levels(f, n, height, width, mechanism, g, g.device) for f, n, g in each]
        )
    else:
        problems = (fraction.flatten(), length.flatten(), group.flatten(), groups)
        task = _Task(*problems, height, width, mechanism)
        levels = task.solve(generator, device if source is None else source.device).reshape(shape)
    if device.type == "cuda" and levels.walls.device.type == "cpu":
        return levels.pin_memory().to(device, non_blocking=True)  # without waiting for the GPU
    return levels.to(device)


def _specifications(
    obstacle_fraction: float | Sequence[float] | Tensor, path_length: int | Sequence[int] | Tensor
) -> tuple[Tensor, Tensor]:
    """Returns both arguments as float64 and int64 tensors of one shape on the CPU."""
    if isinstance(obstacle_fraction, Tensor):
        obstacle_fraction = obstacle_fraction.detach().cpu()
    fraction = torch.as_tensor(obstacle_fraction, dtype=torch.float64)
    fraction, length = torch.broadcast_tensors(fraction, torch.as_tensor(path_length).cpu())
    whole = length.long()
    bad = ~((fraction >= 0) & (fraction < 1) & (length >= 1) & (length == whole))
    if bad.any():
        raise ValueError(
            f"obstacle_fraction={fraction[bad][0]:g} must be at least 0 and below 1, "
            f"path_length={length[bad][0]:g} a whole number of at least 1"
        )
    return fraction, whole


class _Task:
    """Draws the levels of one call, pooled by distinct specification and group.

    Specifications are in ascending order of path length, as the mechanisms need them. Counts are on
    the CPU, and only candidates on the device.
    """

    def __init__(
        self,
        fraction: Tensor,
        length: Tensor,
        group: Tensor,
        groups: int,
        height: int,
        width: int,
        name: str,
    ) -> None:
        self.grid = (height, width)
        self.name = name
        self.mechanism = _MECHANISMS[name]
        obstacles = (fraction * (height * width)).round().long()
        base = height * width + 1
        number = (length * base + obstacles) * groups + group
        specs, spec_of = number.unique(return_inverse=True)
        specs, self.group = specs // groups, specs % groups  # [S]
        self.length, self.obstacles = specs // base, specs % base  # ascending in length
        self.by_group = self.group.argsort(stable=True)
        self.order = spec_of.argsort(stable=True)  # problems, grouped by specification
        self.wanted = spec_of.bincount(minlength=len(specs))  # [S]
        self.first = self.wanted.cumsum(0) - self.wanted  # of each specification in ``order``
        self.example = fraction[self.order[self.first]]
        self._check_necessary()

    def solve(self, generator: Generators, device: torch.device) -> Level:
        """Draws candidates until every problem has its level: ``[N]`` on the device."""
        count, (height, width) = self.order.shape[0], self.grid
        cells = torch.zeros(2, count, 2, dtype=torch.int64, device=device)
        walls = torch.zeros(count, height, width, dtype=torch.bool, device=device)
        result = Level(walls=walls, start=cells[0], goal=cells[1], batch_size=[count])
        drawn, accepted = torch.zeros_like(self.wanted), torch.zeros_like(self.wanted)
        filled = torch.zeros_like(self.wanted)
        while (filled < self.wanted).any():
            share = self._share(self.wanted - filled, drawn, accepted, device.type == "cpu")
            spec_of = torch.arange(len(share)).repeat_interleave(share)  # [C]
            draws = Draws(generator, self.group[spec_of], device)
            kept, level = self.mechanism.draw(
                self.obstacles[spec_of], self.length[spec_of], height, width, draws
            )
            spec_of = spec_of[kept.cpu()]  # [A]
            met = spec_of.bincount(minlength=len(share))
            rank = torch.arange(len(spec_of)) - (met.cumsum(0) - met)[spec_of]
            slot = filled[spec_of] + rank
            used = slot < self.wanted[spec_of]
            problem = self.order[(self.first[spec_of] + slot)[used]].to(device)
            result[problem] = level[used.to(device)]
            drawn += share
            accepted += met
            filled = torch.minimum(filled + met, self.wanted)
            self._check_rarity(filled, drawn, accepted)
        return result

    def _share(self, pending: Tensor, drawn: Tensor, accepted: Tensor, on_cpu: bool) -> Tensor:
        """Returns how many candidates of each specification to draw for the pending levels.

        The rate of success is estimated with a uniform prior (one success and one failure seen in
        advance), so a specification that was never met asks for twice as many each time.
        """
        rate = (accepted + 1) / (drawn + 2)
        share = (1.1 * pending / rate).ceil().long() + 2 * (pending > 0)
        chunk = self.mechanism.chunk if on_cpu else self.mechanism.device_chunk
        ordered, group = share[self.by_group], self.group[self.by_group]
        before = ordered.cumsum(0) - ordered
        before -= before[torch.searchsorted(group, group)]  # only in the same group
        room = torch.empty_like(share).scatter_(0, self.by_group, chunk - before)
        return share.minimum(room.clamp(min=0))

    def _check_necessary(self) -> None:
        """Refuses impossible specifications at once."""
        height, width = self.grid
        free, farthest = height * width - self.obstacles, height + width - 2
        for spec in (free <= self.length).nonzero().flatten():
            moves = self.length[spec]
            self._refuse(
                spec, f"a path of {moves} moves needs {moves + 1} free cells of {free[spec]}"
            )
        for spec in ((self.obstacles == 0) & (self.length > farthest)).nonzero().flatten():
            self._refuse(spec, f"without obstacles no two cells are over {farthest} moves apart")

    def _check_rarity(self, filled: Tensor, drawn: Tensor, accepted: Tensor) -> None:
        """Gives up on specifications that fewer than one in ``limit`` candidates meet."""
        hopeless = (filled < self.wanted) & (drawn > self.mechanism.limit * (accepted + 1))
        for spec in hopeless.nonzero().flatten():
            self._refuse(
                spec,
                f"it is impossible or rarer than 1 in {self.mechanism.limit:,} candidates "
                f"({accepted[spec]} met in {drawn[spec]:,})",
            )

    def _refuse(self, spec: Tensor, reason: str) -> NoReturn:
        height, width = self.grid
        raise ValueError(
            f"cannot make levels with obstacle_fraction={self.example[spec].item():g}, "
            f"path_length={self.length[spec]} on a {height}x{width} grid "
            f"({self.obstacles[spec]} obstacles, mechanism {self.name!r}): {reason}"
        )


_NEVER = 2**31 - 1  # rank of a cell that stays closed
_CLOSED = 100  # added to a cell's count of carved neighbours: it can no longer be carved


class Draws:
    """Draws random matrices with one column for each candidate.

    Each column comes from the generator of the candidate's group, in the order of the group's
    candidates, so that a group's numbers do not depend on other groups.

    Args:
        generators: One generator (None for torch's default one), or one for each group.
        group: int64 ``[C]`` on the CPU, the candidates' groups; unused with one generator.
        device: Of the generators.
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
        """Returns draws for some of the candidates, by their ascending indices, int64 ``[A]``."""
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
    the path length from the start; the goal is uniform over such cells.

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
    # Equal parts of [0, 1) lead to each goal; rounding may make the product equal to their count.
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

    Obstacles are drawn by selection sampling (Knuth, The Art of Computer Programming, vol. 2,
    3.4.2, algorithm S): a cell becomes one with probability (obstacles still needed) / (cells still
    left), which results in their exact number. They are drawn among all cells but the last;
    swapping that free cell with a uniform start cell makes the pair uniform.

    Returns:
        walls, bool ``[H*W, C]``, and start, int64 ``[C]``.
    """
    device, count = draws.device, obstacles.shape[0]
    needed = obstacles.to(device, torch.float32)
    draw = draws.rand(cells - 1)
    # Strictly below the number of cells left, also after rounding, so that none is missing.
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

    Arguments and results are as in :func:`draw_uniform`. A candidate is lost if its path runs into
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

    Cells need not be opened one by one: the first cell that would make a shortcut has the least
    rank that *some* shortcut cannot avoid, and all cells before it can be opened. So each round
    skips one cell in every maze in which such a cell comes before the last cell needed.

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
    """Finds the first cell that makes a shortcut when it is opened after all of lower rank.

    Its rank is the least, over all walks shorter than the path, of the greatest rank on the walk.
    Lengths of walks between two cells of a grid differ by even numbers and a walk may go to and
    fro, so walks of exactly ``path_length - 2`` moves cover all of them.

    Arguments are as in :func:`_open_cells`; the result is the cell's rank, int32 ``[N]``, or
    ``_NEVER``.
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


class _Mechanism(NamedTuple):
    draw: Callable[[Tensor, Tensor, int, int, Draws], tuple[Tensor, Level]]
    limit: int  # candidates per level after which a specification counts as impossible
    chunk: int  # candidates drawn at once on a CPU, so that the working set stays in its cache
    device_chunk: int  # the same on an accelerator, where few large launches are faster
    pools: bool  # whether the count of a candidate's random numbers is independent of others


_MECHANISMS = {
    "uniform": _Mechanism(draw_uniform, 200_000, 8_192, 131_072, True),
    "path_first": _Mechanism(draw_path_first, 100_000, 2_048, 32_768, False),
}
MECHANISMS = tuple(_MECHANISMS)


L = TypeVar("L", bound=Level)

FLIP_WALL, MOVE_GOAL, MOVE_START = range(3)


def edit_levels(levels: L, count: int, generators: Sequence[torch.Generator]) -> L:
    """Returns levels after a number of random edits, one after another.

    An edit is one of three operators, each with probability 1/3:

    - flip: a uniform cell that is neither start nor goal becomes an obstacle, or ceases to be one;
    - the goal moves to a uniform free cell other than start and goal;
    - the start does.

    If there is no such cell, the level stays as it is. The goal may become unreachable.

    This is the mutation of ACCEL (Parker-Holder et al. 2022, arXiv 2203.01302). Libraries draw
    among no change, a flip and a move of the goal; here no edit is wasted, and the start moves,
    too.

    Args:
        levels: valid levels ``[K, n]`` on any device, which are not changed.
        count: edits of each level, at least 0. With the same generators, more edits begin with
            those of fewer.
        generators: K generators on the CPU, of which generator k alone determines levels ``[k]``.

    Returns:
        Valid levels ``[K, n]`` of the same class and device. Other entries stay, such as the
        direction of a :class:`~proposer_rl.tasks.view_mazes.view_levels.ViewLevel`.

    Example:
        >>> levels = Level.from_text(["S..G"] * 4).reshape(1, 4)
        >>> edit_levels(levels, 1, [torch.Generator().manual_seed(0)])[0].to_text()
        ['.S.G', 'S.#G', '.S.G', 'S.#G']
    """
    copies, number = levels.batch_size
    flat = levels.reshape(-1)  # [C]
    for _ in range(count):
        drawn = [
            (torch.randint(3, (number,), generator=draw), torch.rand(number, generator=draw))
            for draw in generators
        ]
        operator, place = (torch.cat(each) for each in zip(*drawn, strict=True))
        flat = _edit(flat, operator.to(levels.walls.device), place.to(levels.walls.device))
    return flat.reshape(copies, number).clone()


def _edit(levels: L, operator: Tensor, place: Tensor) -> L:
    """Edits levels [C] once each, by operators int64 [C] at places float [C] in [0, 1)."""
    width = levels.walls.shape[-1]
    walls = levels.walls.flatten(1)  # [C, H*W]
    start, goal = (cell_index(end, width).unsqueeze(1) for end in (levels.start, levels.goal))
    allowed = ~walls | (operator == FLIP_WALL).unsqueeze(1)
    allowed = allowed.scatter(1, start, False).scatter(1, goal, False)
    marked = allowed.cumsum(1, dtype=torch.int32)  # up to and with each cell
    choices = marked[:, -1]
    # Equal parts of [0, 1) lead to each cell; rounding may make the product equal to their count.
    rank = (place * choices).int().minimum(choices - 1)
    cell = (marked <= rank.unsqueeze(1)).sum(1)  # [C]

    def applies(which: int) -> Tensor:
        return (operator == which) & (choices > 0)

    flipped = torch.zeros_like(walls).scatter(1, cell.unsqueeze(1), applies(FLIP_WALL).unsqueeze(1))
    position = cell_position(cell, width)  # [C, 2]
    edited: L = levels.replace(  # of the levels' own class: a direction stays
        walls=(walls ^ flipped).view_as(levels.walls),
        start=position.where(applies(MOVE_START).unsqueeze(1), levels.start),
        goal=position.where(applies(MOVE_GOAL).unsqueeze(1), levels.goal),
    )
    return edited


class LevelDistribution:
    """A distribution of levels over equally likely specifications.

    The constructor draws a level of each specification, by a generator of its own, to check that it
    can be met.

    Args:
        specifications: Pairs (obstacle fraction, path length), at least one; see
            :class:`~proposer_rl.tasks.mazes.levels.LevelSpec`.
        mechanism: ``"uniform"`` or ``"path_first"``; see
            :func:`generate_levels`.
        height: H, cells.
        width: W, cells.
        device: Of the levels.

    Raises:
        ValueError: If a specification cannot be met.
    """

    def __init__(
        self,
        specifications: Sequence[tuple[float, int]],
        mechanism: str = "uniform",
        height: int = 10,
        width: int = 10,
        device: torch.device | str = "cpu",
    ) -> None:
        self.device = torch.device(device)
        self.specifications = tuple(LevelSpec(*pair) for pair in specifications)
        self.mechanism = mechanism
        self.height = height
        self.width = width
        self.generate(torch.arange(self.size), torch.Generator().manual_seed(0))

    @property
    def size(self) -> int:
        """Returns the number of specifications."""
        return len(self.specifications)

    def decode(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """Returns obstacle fractions, float64, and path lengths, int64, by index ``[*B]``."""
        fractions, lengths = zip(*self.specifications, strict=True)
        return (
            torch.tensor(fractions, dtype=torch.float64, device=index.device)[index],
            torch.tensor(lengths, device=index.device)[index],
        )

    def generate(self, index: Tensor, generator: Generators = None) -> Level:
        """Draws levels ``[*B]`` of the specifications with an index, int64 ``[*B]``.

        Generators are as in :func:`generate_levels`.
        """
        fraction, length = self.decode(index.cpu())
        grid = (self.height, self.width)
        return generate_levels(fraction, length, *grid, self.mechanism, generator, self.device)

    def sample(
        self, batch_shape: int | Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Level:
        """Draws levels ``[*B]``, or ``[B]`` for a number, of random specifications."""
        shape = (batch_shape,) if isinstance(batch_shape, int) else tuple(batch_shape)
        place = "cpu" if generator is None else generator.device
        index = torch.randint(self.size, shape, generator=generator, device=place)
        return self.generate(index, generator)

    def __str__(self) -> str:
        pairs = "; ".join(
            f"{fraction:g} obstacles, path of {length}"
            for fraction, length in self.specifications[:4]
        )
        return f"{pairs}; {self.mechanism}"


class SpecificationSpace(LevelDistribution):
    """All pairs of M obstacle fractions and N path lengths, as bins for a Proposer.

    Bin ``i * N + j`` is ``(obstacle_fractions[i], path_lengths[j])``.

    Args:
        obstacle_fractions: M fractions in [0, 1).
        path_lengths: N numbers of moves.
        mechanism, height, width, device: As in :class:`LevelDistribution`.

    Attributes:
        axes: The M fractions and N lengths, by name.

    Raises:
        ValueError: If a specification cannot be met.

    Example:
        >>> space = SpecificationSpace((0.0, 0.2), (2, 4, 6), height=6, width=6)
        >>> space.size
        6
        >>> space.specifications[4]
        LevelSpec(obstacle_fraction=0.2, path_length=4)
    """

    def __init__(
        self,
        obstacle_fractions: Sequence[float] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5),
        path_lengths: Sequence[int] = (2, 4, 6, 8, 10, 12, 14, 16),
        mechanism: str = "uniform",
        height: int = 10,
        width: int = 10,
        device: torch.device | str = "cpu",
    ) -> None:
        self.axes: dict[str, Sequence[float]] = {
            "obstacle fraction": tuple(obstacle_fractions),
            "path length": tuple(path_lengths),
        }
        pairs = list(product(obstacle_fractions, path_lengths))
        super().__init__(pairs, mechanism, height, width, device)

    @property
    def coordinates(self) -> Tensor:
        """Returns each pair's fraction and length, scaled to [-1, 1]: float [M * N, 2].

        The coordinate on an axis with a single value is 0.
        """
        return torch.cartesian_prod(*self._scaled(*self.axes.values()))

    def locate(self, levels: Level) -> Tensor:
        """Returns the :attr:`coordinates` of levels [*B]: float32 [*B, 2] on the CPU.

        The path length to a goal that cannot be reached counts as the number of cells.
        """
        length = shortest_path_length(levels)
        moves = length.where(length >= 0, self.height * self.width)
        return torch.stack(self._scaled(levels.walls.float().mean((-2, -1)).cpu(), moves.cpu()), -1)

    def nearest(self, specifications: Sequence[LevelSpec]) -> Tensor:
        """Returns the bin nearest to each of n specifications, also to those outside: int64 [n].

        Rounding decides between bins that are equally near.
        """
        scaled = self._scaled(*zip(*specifications, strict=True))
        return torch.cdist(torch.stack(scaled, -1), self.coordinates).argmin(-1)

    def _scaled(self, *lines: Sequence[float] | Tensor) -> list[Tensor]:
        """Returns values scaled to -1 to 1 along each axis, or 0 if it has a single value."""
        scaled = []
        for values, axis in zip(lines, self.axes.values(), strict=True):
            known = torch.tensor(axis, dtype=torch.float32)
            middle, reach = (known.max() + known.min()) / 2, (known.max() - known.min()) / 2
            place = torch.as_tensor(values, dtype=torch.float32)
            scaled.append((place - middle) / reach if reach > 0 else torch.zeros_like(place))
        return scaled
