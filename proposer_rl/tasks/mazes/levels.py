"""Represents mazes as cells, texts and planes, and finds their shortest paths.

A search spreads a frontier over all mazes of a batch at once. Grids are laid out *cells first*,
``[H, W, N]``: a shifted grid is then a view whose rows are N contiguous entries, and each step
takes a few vectorised passes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, Self

import torch
from tensordict import TensorClass
from torch import Tensor
from torch.nn.functional import pad

WALL, FREE, START, GOAL = "#", ".", "S", "G"


class LevelSpec(NamedTuple):
    """The specification of a level.

    Attributes:
        obstacle_fraction: Obstacles per cell, in [0, 1); a grid of H x W cells has exactly
            ``round(obstacle_fraction * H * W)`` obstacles.
        path_length: Moves on the shortest path from start to goal, at least 1.
    """

    obstacle_fraction: float
    path_length: int


class Level(TensorClass):
    """Mazes: walls, one start cell and one goal cell each, of any batch shape ``[*B]``.

    Attributes:
        walls: bool ``[*B, H, W]``, True where a cell is an obstacle.
        start: int64 ``[*B, 2]``, row and column of the start cell.
        goal: int64 ``[*B, 2]``, row and column of the goal cell.
    """

    walls: Tensor
    start: Tensor
    goal: Tensor

    @classmethod
    def from_text(cls, text: str | Sequence[str]) -> Self:
        """Reads levels that are drawn with one character per cell.

        Args:
            text: One drawing (lines of ``#`` wall, ``.`` free, ``S`` start, ``G`` goal; blank
                lines and indentation are ignored), or a sequence of drawings of equal size.

        Returns:
            A level of batch shape ``[]``, or ``[n]`` for a sequence of n drawings.

        Raises:
            ValueError: If a drawing is not a rectangle, has another character, or does not have
                exactly one start and one goal.
            RuntimeError: If the drawings differ in size.

        Example:
            >>> level = Level.from_text('''
            ... S.#
            ... #.G
            ... ''')
            >>> level.goal
            tensor([1, 2])
            >>> print(level.to_text())
            S.#
            #.G
        """
        if isinstance(text, str):
            return cls._parse(text)
        levels: Any = torch.stack([cls._parse(drawing) for drawing in text])
        return levels

    @classmethod
    def _parse(cls, drawing: str) -> Any:
        """Reads the level of one drawing."""
        rows = [row for row in map(str.strip, drawing.splitlines()) if row]
        flat = "".join(rows)
        ends = sorted(flat.replace(WALL, "").replace(FREE, ""))
        if len({*map(len, rows)}) != 1 or ends != sorted([START, GOAL]):
            raise ValueError(
                f"a level is a rectangle of '#' and '.', with one 'S' and one 'G', got {rows!r:.99}"
            )
        width = len(rows[0])
        return Level(
            walls=torch.tensor([[mark == WALL for mark in row] for row in rows]),
            start=torch.tensor(divmod(flat.index(START), width)),
            goal=torch.tensor(divmod(flat.index(GOAL), width)),
            batch_size=[],
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Level:
        return self.clone()

    def to_text(self) -> Any:
        """Draws the levels with one character per cell; the inverse of :meth:`from_text`.

        Returns:
            One string for batch shape ``[]``, else a list (of lists) of strings.
        """
        if self.batch_dims:
            return [level.to_text() for level in self.unbind(0)]
        cells = [[WALL if wall else FREE for wall in row] for row in self.walls.tolist()]
        for (row, column), mark in ((self.start.tolist(), START), (self.goal.tolist(), GOAL)):
            cells[row][column] = mark
        return "\n".join("".join(row) for row in cells)


def planes(level: Level) -> Tensor:
    """Encodes levels ``[*B]`` as obstacles, start and goal: binary float32 ``[*B, 3, H, W]``."""
    grid = level.walls.shape[-2:]
    cells = (cell_plane(level.start, grid), cell_plane(level.goal, grid))
    return torch.stack([level.walls.float(), *cells], dim=-3)


def cell_plane(cell: Tensor, grid: Sequence[int]) -> Tensor:
    """Draws cells int64 ``[*B, 2]``, row and column, as binary planes float32 ``[*B, H, W]``."""
    height, width = grid
    plane = torch.zeros(*cell.shape[:-1], height * width, dtype=torch.float32, device=cell.device)
    plane.scatter_(-1, cell_index(cell, width).unsqueeze(-1), 1.0)
    return plane.unflatten(-1, (height, width))


def cell_index(cell: Tensor, width: int) -> Tensor:
    """Returns numbers of cells, counted row by row, int64 ``[*B]``, from rows and columns."""
    return cell[..., 0] * width + cell[..., 1]


def cell_position(index: Tensor, width: int) -> Tensor:
    """Returns rows and columns, int64 ``[*B, 2]``, of numbered cells, int64 ``[*B]``."""
    return torch.stack([index // width, index % width], dim=-1)


def validate_levels(level: Level) -> None:
    """Checks hand-designed levels.

    Args:
        level: Levels of any batch shape.

    Raises:
        ValueError: If a shape or dtype is wrong, a start or goal lies outside of the grid or on an
            obstacle, both are the same cell, or a direction is not one; the message says which
            fault it is and how many levels have it.
    """
    walls, direction = level.walls, getattr(level, "direction", None)
    height, width = walls.shape[-2:]
    expected: list[tuple[str, Tensor, torch.dtype, tuple[int, ...]]]
    expected = [("walls", walls, torch.bool, (height, width))]
    expected += [(name, getattr(level, name), torch.int64, (2,)) for name in ("start", "goal")]
    if direction is not None:
        expected.append(("direction", direction, torch.int64, ()))
    for name, entry, dtype, shape in expected:
        if (entry.dtype, entry.shape) != (dtype, (*level.batch_size, *shape)):
            raise ValueError(
                f"{name} must be {dtype} {[*level.batch_size, *shape]}, "
                f"got {entry.dtype} {list(entry.shape)}"
            )
    limits = torch.tensor([height, width], device=walls.device)
    for name, cell in (("start", level.start), ("goal", level.goal)):
        _refuse_any(((cell < 0) | (cell >= limits)).any(-1), f"{name} outside {height}x{width}")
        index = cell_index(cell, width).unsqueeze(-1)
        _refuse_any(walls.flatten(-2).gather(-1, index), f"{name} on an obstacle")
    _refuse_any((level.start == level.goal).all(-1), "start and goal on the same cell")
    if direction is not None:
        _refuse_any((direction < 0) | (direction > 3), "direction outside 0..3")


def _refuse_any(bad: Tensor, fault: str) -> None:
    if count := int(bad.sum()):
        raise ValueError(f"{count} of {bad.numel()} levels have the {fault}")


MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Change of row and column by the actions 0 up, 1 down, 2 left, 3 right."""


def successors(level: Level) -> Tensor:
    """Tabulates the cell after each action in each cell.

    After a move into an obstacle or out of the grid it is the same cell.

    Args:
        level: Levels of batch shape ``[*B]``.

    Returns:
        int64 ``[*B, 4, H*W]``, numbers of cells (row * W + column), by action and cell.
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
    """Returns the nodes of a path of fewest actions, with both ends.

    Of several it is the one whose actions come first. None if there is no path.

    Args:
        following: the node after each action in each node.
        start: the first node.
        arrived: function of a node to whether the path may end there.
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


STEPS_BETWEEN_CHECKS = 8  # each check for an empty frontier waits for the device


def shortest_path_length(level: Level) -> Tensor:
    """Returns the number of moves on the shortest path from start to goal.

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
    """Returns ``[*B, H, W]`` as a contiguous ``[H, W, N]`` of N mazes."""
    return grid.reshape(-1, *grid.shape[-2:]).permute(1, 2, 0).contiguous()


def depth_schedule(depth: Tensor) -> list[tuple[int, int]]:
    """Plans a search in which every maze stops at its own depth.

    Mazes are in ascending order of depth, so that those that still take part are a slice.

    Args:
        depth: int64 ``[N]``, ascending, on the CPU.

    Returns:
        For each step s = 1, 2, ..., max(depth) a pair (first, end): mazes ``first:`` take part in
        it, and for mazes ``first:end`` it is the last step.
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
    """Returns numbers of cells in the grid with a rim on every side, from numbers without it."""
    return (cell // width + 1) * (width + 2) + cell % width + 1


def _begin(free: Tensor, source: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the first frontier, ``[H + 2, W + 2, N]`` with an empty rim, and unvisited cells."""
    height, width, count = free.shape
    frontier = free.new_zeros(height + 2, width + 2, count)
    frontier.flatten(0, 1).scatter_(0, padded_index(source, width).unsqueeze(0), True)
    return frontier, free & ~frontier[1:-1, 1:-1]


def _spread(frontier: Tensor, spare: Tensor, unvisited: Tensor) -> None:
    """Writes the next frontier into ``spare``, and removes it from ``unvisited``."""
    following = spare[1:-1, 1:-1]
    torch.bitwise_or(frontier[:-2, 1:-1], frontier[2:, 1:-1], out=following)
    following |= frontier[1:-1, :-2]
    following |= frontier[1:-1, 2:]
    following &= unvisited
    unvisited ^= following
