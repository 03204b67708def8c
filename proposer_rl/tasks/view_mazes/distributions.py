"""What levels are drawn from: named kinds of them, and the Proposer's bins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.distance import shortest_path_length
from proposer_rl.tasks.mazes.generation import generate_levels
from proposer_rl.tasks.view_mazes.generation import (
    four_rooms,
    perfect_mazes,
    scattered_walls,
    solvable,
)
from proposer_rl.tasks.view_mazes.levels import AHEAD, ViewLevel, directed
from proposer_rl.tasks.view_mazes.settings import (
    DistributionSettings,
    PerfectSettings,
    RoomsSettings,
    ScatteredSettings,
    SpaceSettings,
)

ENDS = 2  # cells that are no walls: start and goal


class ViewDistribution:
    """Levels of one kind.

    Args:
        settings: the kind.
        height, width: of the grid.
        device: where the levels are returned.

    Raises:
        ValueError: if there are no such levels on this grid.
    """

    def __init__(
        self, settings: DistributionSettings, height: int, width: int, device: torch.device
    ) -> None:
        if isinstance(settings, ScatteredSettings):
            if settings.fewest > settings.most:
                raise ValueError(f"fewest={settings.fewest} must be at most most={settings.most}")
            _check_walls(settings.most, height, width)
        self._settings, self._grid, self._device = settings, (height, width), device
        self.sample(1, torch.Generator().manual_seed(0))

    def sample(self, count: int, generator: torch.Generator) -> ViewLevel:
        """Draw levels [count]; the generator is one of the CPU."""
        return self._draw(count, generator).to(self._device)

    def _draw(self, count: int, generator: torch.Generator) -> ViewLevel:
        settings = self._settings
        if isinstance(settings, PerfectSettings):
            return perfect_mazes(count, *self._grid, generator)
        if isinstance(settings, RoomsSettings):
            return four_rooms(count, *self._grid, generator)

        def scattered(number: int) -> ViewLevel:
            ends = (settings.fewest, settings.most + 1)
            walls = torch.randint(*ends, (number,), generator=generator)
            return scattered_walls(walls, *self._grid, generator)

        return solvable(scattered, count) if settings.solvable else scattered(count)

    def __str__(self) -> str:
        kind = self._settings
        if not isinstance(kind, ScatteredSettings):
            return kind.kind.replace("_", " ")
        solvable = ", solvable" if kind.solvable else ""
        return f"{kind.fewest} to {kind.most} walls anywhere{solvable}"


class ViewSpace:
    """Bins of levels: every number of walls, or each of these with every length of the path.

    Without lengths start and goal are anywhere, and may have no path between them: levels drawn
    uniformly from all bins are domain randomization as in PLR, ACCEL and SFL. With lengths every
    level has a shortest path of exactly so many moves.

    Args:
        settings: numbers and lengths.
        height, width: of the grid.
        device: where the levels are returned.

    Attributes:
        axes: the values along each axis, by name.
        size: number N of bins.
        coordinates: of each bin, scaled to [-1, 1] along every axis, 0 where it has one value,
            float32 [N, D].

    Raises:
        ValueError: if a value is repeated or there are no levels of a bin.
    """

    def __init__(
        self, settings: SpaceSettings, height: int, width: int, device: torch.device
    ) -> None:
        self.axes: dict[str, Sequence[float]] = {"walls": tuple(settings.walls)}
        if settings.path_lengths is not None:
            self.axes["path length"] = tuple(settings.path_lengths)
        for name, values in self.axes.items():
            if len(set(values)) < len(values):
                raise ValueError(f"{name} must be distinct, got {list(values)}")
        _check_walls(max(settings.walls), height, width)
        self._grid, self._device = (height, width), device
        self._values = torch.tensor(list(product(*self.axes.values())))  # int64 [N, D]
        self.size = len(self._values)
        middle = (self._values.amax(0) + self._values.amin(0)) / 2
        self._middle, self._reach = middle, (self._values.amax(0) - middle).clamp(min=0.5)
        self.coordinates = self._scaled(self._values)
        self.generate(torch.arange(self.size).unsqueeze(0), [torch.Generator().manual_seed(0)])

    def sample(self, count: int, generator: torch.Generator) -> ViewLevel:
        """Draw levels [count] uniformly from the bins."""
        choices = torch.randint(self.size, (1, count), generator=generator)
        return self.generate(choices, [generator])[0]

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator]) -> ViewLevel:
        """Levels [K, P] of bins, int64 [K, P]; replica k's are drawn from generator k."""
        pairs = zip(choices.cpu(), generators, strict=True)
        levels = [self._generate(self._values[index], draw) for index, draw in pairs]
        return torch.stack(levels).to(self._device)  # type: ignore[arg-type, return-value]

    def locate(self, levels: ViewLevel) -> Tensor:
        """Where levels [*B] lie, as the coordinates: float32 [*B, D] on the CPU.

        A goal that cannot be reached counts as far away as there are cells.
        """
        counts = self._counts(levels)
        return self._scaled(counts.where(counts >= 0, math.prod(self._grid)))

    def shares(self, levels: ViewLevel) -> Tensor:
        """Shares of the bins that are nearest to levels [n], float32 [N]; unsolvable ones are none.

        Without lengths all of the levels count.
        """
        counts = self._counts(levels)
        distance = torch.cdist(self._scaled(counts), self.coordinates)
        nearest = distance.argmin(1)[counts[:, -1] >= 0]
        return nearest.bincount(minlength=self.size) / len(nearest)

    def _counts(self, levels: ViewLevel) -> Tensor:
        """Walls, and where it is an axis the path's length (-1 for none): int64 [*B, D]."""
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
    if most > height * width - ENDS:
        raise ValueError(
            f"{height}x{width} cells have at most {height * width - ENDS} walls beside start and "
            f"goal, got {most}"
        )
