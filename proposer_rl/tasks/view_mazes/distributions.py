"""What levels are drawn from: named kinds of them, and the Proposer's bins."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.distance import shortest_path_length
from proposer_rl.tasks.mazes.generation import generate_levels
from proposer_rl.tasks.view_mazes.generation import (
    Draw,
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
        self._draw = _draw_of(settings, height, width)
        self._device = device
        self.sample(1, torch.Generator().manual_seed(0))

    def sample(self, count: int, generator: torch.Generator) -> ViewLevel:
        """Draw levels [count]; the generator is one of the CPU."""
        return self._draw(count, generator).to(self._device)


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
        self._height, self._width, self._device = height, width, device
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
        values = [levels.walls.flatten(-2).sum(-1)]
        if "path length" in self.axes:
            length = shortest_path_length(levels)
            values.append(length.where(length >= 0, self._height * self._width))
        return self._scaled(torch.stack(values, -1).cpu())

    def shares(self, levels: ViewLevel) -> Tensor:
        """Shares of the bins that are nearest to levels [n], float32 [N]; unsolvable ones are none.

        Without lengths all of the levels count.
        """
        counts = [levels.walls.flatten(1).sum(1).cpu()]
        if "path length" in self.axes:
            counts.append(shortest_path_length(levels).cpu())
        values = torch.stack(counts, 1)
        distance = torch.cdist(self._scaled(values), self.coordinates)
        nearest = distance.argmin(1)[values[:, -1] >= 0]
        return nearest.bincount(minlength=self.size) / len(nearest)

    def _scaled(self, values: Tensor) -> Tensor:
        return (values - self._middle) / self._reach

    def _generate(self, values: Tensor, draw: torch.Generator) -> ViewLevel:
        walls = values[:, 0]
        if values.shape[1] == 1:
            return scattered_walls(walls, self._height, self._width, draw)
        fraction = walls.double() / (self._height * self._width)
        levels = generate_levels(fraction, values[:, 1], self._height, self._width, generator=draw)
        return directed(levels, torch.randint(len(AHEAD), (len(walls),), generator=draw))


def _draw_of(settings: DistributionSettings, height: int, width: int) -> Draw:
    """What draws levels of a kind."""
    if isinstance(settings, PerfectSettings):
        return lambda count, draw: perfect_mazes(count, height, width, draw)
    if isinstance(settings, RoomsSettings):
        return lambda count, draw: four_rooms(count, height, width, draw)
    fewest, most = settings.fewest, settings.most
    if fewest > most:
        raise ValueError(f"fewest={fewest} must be at most most={most}")
    _check_walls(most, height, width)

    def scattered(count: int, draw: torch.Generator) -> ViewLevel:
        walls = torch.randint(fewest, most + 1, (count,), generator=draw)
        return scattered_walls(walls, height, width, draw)

    return solvable(scattered) if settings.solvable else scattered


def _check_walls(most: int, height: int, width: int) -> None:
    if most > height * width - ENDS:
        raise ValueError(
            f"{height}x{width} cells have at most {height * width - ENDS} walls beside start and "
            f"goal, got {most}"
        )
