"""Draws levels in which an agent looks in a direction.

Functions that draw return levels ``[N]`` of height x width cells. These and the generator ``draw``
are on the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Len
from torch import Tensor

from proposer_rl.settings import BY_KIND, settings
from proposer_rl.tasks.mazes.generation import generate_levels
from proposer_rl.tasks.mazes.levels import START, Level, cell_position, shortest_path_length

AGENTS = (">", "v", "<", "^")
"""Characters of the agent in a drawing, by direction: 0 right, 1 down, 2 left, 3 up."""

AHEAD = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Change of row and column by a move forward, by direction."""

ENDPOINTS = 2  # start and goal, which are no walls
Walls = Annotated[int, Ge(0)]


class ViewLevel(Level):
    """Mazes whose agent begins in a direction, of any batch shape ``[*B]``.

    In a drawing the start is ``>``, ``v``, ``<`` or ``^`` by the agent's direction; with an ``S``
    the agent looks to the right.

    Attributes:
        direction: int64 ``[*B]``, 0 right, 1 down, 2 left, 3 up.
    """

    direction: Tensor

    @classmethod
    def _parse(cls, drawing: str) -> ViewLevel:
        marks = [mark for mark in drawing if mark in AGENTS]
        for mark in AGENTS:
            drawing = drawing.replace(mark, START)
        direction = AGENTS.index(marks[0]) if marks else 0
        return directed(Level.from_text(drawing), torch.tensor(direction))

    def to_text(self) -> Any:
        """Draws the levels with one character per cell; the inverse of :meth:`from_text`.

        Example:
            >>> level = ViewLevel.from_text('''
            ... v.#
            ... #.G
            ... ''')
            >>> level.direction
            tensor(1)
            >>> print(level.to_text())
            v.#
            #.G
        """
        text = super().to_text()
        return text if self.batch_dims else text.replace(START, AGENTS[int(self.direction)])


def directed(level: Level, direction: Tensor) -> ViewLevel:
    """Returns levels [*B] with the first directions of their agents, int64 [*B]."""
    return ViewLevel(
        walls=level.walls,
        start=level.start,
        goal=level.goal,
        direction=direction,
        batch_size=level.batch_size,
    )


@settings
class ScatteredSettings:
    """Walls anywhere, with equally likely numbers of them from ``fewest`` to ``most``.

    Attributes:
        solvable: whether to draw a level again if its goal cannot be reached.
    """

    kind: Literal["scattered"] = "scattered"
    fewest: Walls = 0
    most: Walls = 60
    solvable: bool = False


@settings
class PerfectSettings:
    """Mazes with exactly one path between any two cells."""

    kind: Literal["perfect"] = "perfect"


ViewDistributionSettings = Annotated[ScatteredSettings | PerfectSettings, BY_KIND]


@settings
class ViewSpaceSettings:
    """Settings of the Proposer's bins.

    Attributes:
        walls: numbers of walls.
        path_lengths: moves on the shortest path, each with every number of walls; None for start
            and goal anywhere, as in the field.
    """

    walls: Annotated[list[Walls], Len(1)]
    path_lengths: Annotated[list[Annotated[int, Ge(1)]], Len(1)] | None = None


class ViewDistribution:
    """A distribution of levels.

    Args:
        settings: the kind of levels.
        height, width: of the grid.
        device: of the levels.

    Raises:
        ValueError: if there are no such levels on this grid.
    """

    def __init__(
        self, settings: ViewDistributionSettings, height: int, width: int, device: torch.device
    ) -> None:
        if isinstance(settings, ScatteredSettings):
            _check_walls(settings.most, height, width)
        self._settings, self._grid, self._device = settings, (height, width), device
        self.sample(1, torch.Generator().manual_seed(0))

    def sample(self, count: int, generator: torch.Generator) -> ViewLevel:
        """Draws levels [count] by a generator on the CPU."""
        return self._draw(count, generator).to(self._device)

    def _draw(self, count: int, generator: torch.Generator) -> ViewLevel:
        settings = self._settings
        if isinstance(settings, PerfectSettings):
            return perfect_mazes(count, *self._grid, generator)

        def scattered(number: int) -> ViewLevel:
            ends = (settings.fewest, settings.most + 1)
            walls = torch.randint(*ends, (number,), generator=generator)
            return scattered_walls(walls, *self._grid, generator)

        return solvable(scattered, count) if settings.solvable else scattered(count)

    def __str__(self) -> str:
        kind = self._settings
        if not isinstance(kind, ScatteredSettings):
            return kind.kind
        solvable = ", solvable" if kind.solvable else ""
        return f"{kind.fewest} to {kind.most} walls anywhere{solvable}"


class ViewSpace:
    """Bins of levels by their number of walls, and perhaps by the length of their shortest path.

    Without lengths start and goal are anywhere, perhaps without a path between them: levels drawn
    uniformly from all bins are domain randomization as in PLR, ACCEL and SFL. With lengths every
    level has a shortest path of exactly so many moves.

    Args:
        settings: numbers and lengths.
        height, width: of the grid.
        device: of the levels.

    Attributes:
        axes: the values along each axis, by name.
        size: number N of bins.
        coordinates: of each bin, scaled to [-1, 1] along every axis, or 0 along one of a single
            value, float32 [N, D].

    Raises:
        ValueError: if a bin has no levels.
    """

    def __init__(
        self, settings: ViewSpaceSettings, height: int, width: int, device: torch.device
    ) -> None:
        self.axes: dict[str, Sequence[float]] = {"walls": tuple(settings.walls)}
        if settings.path_lengths is not None:
            self.axes["path length"] = tuple(settings.path_lengths)
        _check_walls(max(settings.walls), height, width)
        self._grid, self._device = (height, width), device
        self._values = torch.tensor(list(product(*self.axes.values())))  # int64 [N, D]
        self.size = len(self._values)
        middle = (self._values.amax(0) + self._values.amin(0)) / 2
        self._middle, self._reach = middle, (self._values.amax(0) - middle).clamp(min=0.5)
        self.coordinates = self._scaled(self._values)
        self.generate(torch.arange(self.size).unsqueeze(0), [torch.Generator().manual_seed(0)])

    def sample(self, count: int, generator: torch.Generator) -> ViewLevel:
        """Draws levels [count] uniformly from the bins."""
        choices = torch.randint(self.size, (1, count), generator=generator)
        return self.generate(choices, [generator])[0]

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator]) -> ViewLevel:
        """Draws levels [K, P] from bins, int64 [K, P]; generator k draws row k."""
        pairs = zip(choices.cpu(), generators, strict=True)
        levels = [self._generate(self._values[index], draw) for index, draw in pairs]
        return torch.stack(levels).to(self._device)  # type: ignore[arg-type, return-value]

    def locate(self, levels: ViewLevel) -> Tensor:
        """Returns the coordinates of levels [*B]: float32 [*B, D] on the CPU.

        The path length to a goal that cannot be reached counts as the number of cells.
        """
        counts = self._counts(levels)
        return self._scaled(counts.where(counts >= 0, math.prod(self._grid)))

    def shares(self, levels: ViewLevel) -> Tensor:
        """Returns the share of levels [n] nearest to each bin: float32 [N].

        With lengths only solvable levels count.
        """
        counts = self._counts(levels)
        distance = torch.cdist(self._scaled(counts), self.coordinates)
        nearest = distance.argmin(1)[counts[:, -1] >= 0]
        return nearest.bincount(minlength=self.size) / len(nearest)

    def _counts(self, levels: ViewLevel) -> Tensor:
        """Returns numbers of walls, and path lengths (-1 for none) if an axis: int64 [*B, D]."""
        counts = [levels.walls.flatten(-2).sum(-1)]
        if "path length" in self.axes:
            counts.append(shortest_path_length(levels))
        return torch.stack(counts, -1).cpu()

    def _scaled(self, values: Tensor) -> Tensor:
        return (values - self._middle) / self._reach

    def _generate(self, values: Tensor, draw: torch.Generator) -> ViewLevel:
        walls = values[:, 0]
        if values.shape[1] == 1:
            return scattered_walls(walls, *self._grid, draw)
        fraction = walls.double() / math.prod(self._grid)
        levels = generate_levels(fraction, values[:, 1], *self._grid, generator=draw)
        return directed(levels, torch.randint(len(AHEAD), (len(walls),), generator=draw))


def _check_walls(most: int, height: int, width: int) -> None:
    if most > height * width - ENDPOINTS:
        raise ValueError(
            f"{height}x{width} cells have at most {height * width - ENDPOINTS} walls beside "
            f"start and goal, got {most}"
        )


MOST_DRAWS = 1000  # of a level until its goal can be reached


def scattered_walls(count: Tensor, height: int, width: int, draw: torch.Generator) -> ViewLevel:
    """Draws levels with exact numbers of walls, uniform cells and uniform directions.

    The goal may be out of reach, as in PLR's and jaxued's levels. The numbers are int64 ``[N]`` on
    the CPU, at most height * width - 2.
    """
    order = torch.rand(len(count), height * width, generator=draw).argsort(1)
    # The first two cells of a random order are start and goal, the next ones walls.
    wall = torch.arange(height * width) < count.unsqueeze(1) + 2
    walls = torch.zeros_like(wall).scatter(1, order, wall)
    walls.scatter_(1, order[:, :2], False)
    return _level_of(walls.unflatten(1, (height, width)), order[:, :2], draw)


def perfect_mazes(number: int, height: int, width: int, draw: torch.Generator) -> ViewLevel:
    """Draws mazes with one path between any two free cells, by a random depth-first search.

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


def solvable(draw_levels: Callable[[int], ViewLevel], number: int) -> ViewLevel:
    """Draws levels until the goal of each can be reached."""
    levels = draw_levels(number)
    for _ in range(MOST_DRAWS):
        bad = (shortest_path_length(levels) < 0).nonzero().squeeze(1)
        if not len(bad):
            return levels
        levels[bad] = draw_levels(len(bad))
    raise ValueError(f"in {MOST_DRAWS} draws of a level its goal could not be reached")


def _placed(walls: Tensor, draw: torch.Generator) -> ViewLevel:
    """Returns levels of walls [N, H, W] with two uniform free cells as start and goal."""
    chance = torch.rand(walls.flatten(1).shape, generator=draw)
    ends = chance.where(~walls.flatten(1), -1.0).topk(2, 1).indices
    return _level_of(walls, ends, draw)


def _level_of(walls: Tensor, ends: Tensor, draw: torch.Generator) -> ViewLevel:
    """Returns levels of walls [N, H, W] and ends [N, 2], start and goal, in random directions."""
    start, goal = cell_position(ends, walls.shape[-1]).unbind(1)
    return ViewLevel(
        walls=walls,
        start=start,
        goal=goal,
        direction=torch.randint(len(AHEAD), (len(walls),), generator=draw),
        batch_size=[len(walls)],
    )
