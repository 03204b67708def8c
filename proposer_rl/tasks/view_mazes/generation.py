"""How levels are drawn: walls anywhere, mazes without loops, four rooms.

All levels ``[N]`` are on the CPU, with height x width cells; so is the generator ``draw``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.distance import shortest_path_length
from proposer_rl.tasks.mazes.levels import cell_position
from proposer_rl.tasks.view_mazes.levels import AHEAD, ViewLevel

MOST_DRAWS = 1000  # of a level whose goal is to be reachable


def scattered_walls(count: Tensor, height: int, width: int, draw: torch.Generator) -> ViewLevel:
    """Levels with exact numbers of walls; their cells, start, goal and direction are uniform.

    Nothing else is asked of them: the goal may be out of reach, as in PLR's and jaxued's. The
    numbers are int64 ``[N]`` on the CPU, at most height * width - 2.
    """
    order = torch.rand(len(count), height * width, generator=draw).argsort(1)
    # The first two cells of a random order are start and goal, the next ones walls.
    wall = torch.arange(height * width) < count.unsqueeze(1) + 2
    walls = torch.zeros_like(wall).scatter(1, order, wall)
    walls.scatter_(1, order[:, :2], False)
    return _level(walls.unflatten(1, (height, width)), order[:, :2], draw)


def perfect_mazes(number: int, height: int, width: int, draw: torch.Generator) -> ViewLevel:
    """Mazes with exactly one way between any two free cells: a random depth-first search.

    The cells of even row and column are all free; the search opens the cells between them. Start,
    goal and direction are uniform.

    Raises:
        ValueError: If a side is even.
    """
    if height % 2 == 0 or width % 2 == 0:
        raise ValueError(f"perfect mazes have odd sides, got {height}x{width}")
    rows, columns = height // 2 + 1, width // 2 + 1
    levels = torch.arange(number)
    step = torch.tensor(AHEAD)  # [4, 2]
    new = torch.ones(number, rows + 2, columns + 2, dtype=torch.bool)  # with a rim that is not new
    new[:, [0, -1]], new[:, :, [0, -1]] = False, False
    free = torch.zeros(number, height, width, dtype=torch.bool)
    first = [torch.randint(1, side + 1, (number,), generator=draw) for side in (rows, columns)]
    here = torch.stack(first, 1)
    trail = torch.empty(rows * columns, number, 2, dtype=torch.int64)  # from the first cell to here
    depth = torch.zeros(number, dtype=torch.int64)
    new[levels, here[:, 0], here[:, 1]] = False
    free[:, ::2, ::2] = True
    # Every cell is entered once and left once.
    for _ in range(2 * rows * columns - 2):
        beside = here.unsqueeze(1) + step  # [N, 4, 2]
        open_ = new[levels.unsqueeze(1), beside[..., 0], beside[..., 1]]
        chance = torch.rand(number, len(AHEAD), generator=draw)
        moved = step[chance.where(open_, -1.0).argmax(1)]
        on = open_.any(1)
        trail[depth, levels] = here
        depth = torch.where(on, depth + 1, (depth - 1).clamp(min=0))
        there = torch.where(on.unsqueeze(1), here + moved, trail[depth, levels])
        between = 2 * here - 2 + moved * on.unsqueeze(1)
        free[levels, between[:, 0], between[:, 1]] = True
        new[levels, there[:, 0], there[:, 1]] = False
        here = there
    return _placed(~free, draw)


def four_rooms(number: int, height: int, width: int, draw: torch.Generator) -> ViewLevel:
    """Four rooms around a cross of walls, each of whose arms has one door at a random place.

    Start, goal and direction are uniform.

    Raises:
        ValueError: If a side is less than 3.
    """
    if min(height, width) < 3:
        raise ValueError(f"four rooms need at least 3x3 cells, got {height}x{width}")
    middle = (height // 2, width // 2)
    walls = torch.zeros(number, height, width, dtype=torch.bool)
    walls[:, middle[0]], walls[:, :, middle[1]] = True, True
    levels = torch.arange(number)
    for arm, first, last in (
        (walls[:, middle[0]], 0, middle[1]),
        (walls[:, middle[0]], middle[1] + 1, width),
        (walls[:, :, middle[1]], 0, middle[0]),
        (walls[:, :, middle[1]], middle[0] + 1, height),
    ):
        arm[levels, torch.randint(first, last, (number,), generator=draw)] = False
    return _placed(walls, draw)


def solvable(draw_levels: Callable[[int], ViewLevel], number: int) -> ViewLevel:
    """Drawn levels whose goal can be reached; others are drawn again."""
    levels = draw_levels(number)
    for _ in range(MOST_DRAWS):
        bad = (shortest_path_length(levels) < 0).nonzero().squeeze(1)
        if not len(bad):
            return levels
        levels[bad] = draw_levels(len(bad))
    raise ValueError(f"in {MOST_DRAWS} draws of a level its goal could not be reached")


def _placed(walls: Tensor, draw: torch.Generator) -> ViewLevel:
    """Levels of walls [N, H, W]; start and goal are different uniform free cells."""
    chance = torch.rand(walls.flatten(1).shape, generator=draw)
    ends = chance.where(~walls.flatten(1), -1.0).topk(2, 1).indices
    return _level(walls, ends, draw)


def _level(walls: Tensor, ends: Tensor, draw: torch.Generator) -> ViewLevel:
    """Levels of walls [N, H, W] and cells of start and goal [N, 2]; the direction is uniform."""
    start, goal = cell_position(ends, walls.shape[-1]).unbind(1)
    return ViewLevel(
        walls=walls,
        start=start,
        goal=goal,
        direction=torch.randint(len(AHEAD), (len(walls),), generator=draw),
        batch_size=[len(walls)],
    )
