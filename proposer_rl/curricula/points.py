"""Turns points of a box into levels, for curricula that draw from continuous distributions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

import torch
from annotated_types import Interval
from torch import Tensor

from proposer_rl.curricula.batches import levels_in
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, Space, refuse_unfit_bins

CHUNK = 2**16  # places to compare at once
Place = Annotated[float, Interval(ge=-1, le=1)]
"""A parameter's place in its range, from -1 to 1."""


class Points:
    """Turns points of the box [-1, 1]^D, which the coordinates of a space span, into levels.

    Args:
        space: that has the bins.
        rounded: whether to round points to the nearest bins; otherwise points are levels
            themselves, which needs a space of continuous parameters (with a method ``at``).

    Attributes:
        size: the number D of coordinates.

    Raises:
        ArgumentError: if the space has a single bin or too many.
    """

    def __init__(self, space: Space, rounded: bool) -> None:
        refuse_unfit_bins(space, 1 if space.axes and not rounded else 2)
        self._space, self._rounded = space, rounded
        places = space.coordinates.double()
        self.size: int = places.shape[1]
        # Of a grid, in the order of its bins, the places along each axis; of others None.
        self._lines: list[Tensor] | None = None
        lines = [line.unique() for line in places.mT]
        if math.prod(map(len, lines)) == len(places):
            grid = torch.cartesian_prod(*lines).reshape(places.shape)
            self._lines = [line.unsqueeze(-1) for line in lines] if grid.equal(places) else None

    @property
    def free(self) -> Tensor:
        """Returns the coordinates along which levels can differ, int64 [F]."""
        places = self._space.coordinates
        differ = places.amax(0) > places.amin(0)
        return (differ | (not self._rounded)).nonzero().flatten()

    def levels(self, points: Tensor, rng: Streams) -> tuple[Levels, Tensor]:
        """Returns the levels [n] at points float64 [n, D], and their bins, int64 [n]."""
        bins, draw = self._nearest(points), rng.generator("levels")
        space: Any = self._space  # only one of continuous parameters has a method `at`
        if self._rounded:
            return levels_in(space, bins, draw), bins
        return space.at(points.unsqueeze(0), [draw])[0], bins

    def _nearest(self, points: Tensor) -> Tensor:
        """Returns the bins nearest to points float64 [m, D], int64 [m]."""
        if self._lines is None:
            return nearest(points, self._space.coordinates.double())
        bins = torch.zeros(len(points), dtype=torch.int64)
        for line, along in zip(self._lines, points.split(1, -1), strict=True):
            bins = bins * len(line) + nearest(along, line)
        return bins

    def tasks(self, points: Tensor, bins: Tensor) -> Tensor:
        """Returns where the levels at points float64 [n, D] lie, float64 [n, D]."""
        return self._space.coordinates.double()[bins] if self._rounded else points

    def at(self, start: Mapping[str, float] | None) -> Tensor:
        """Returns the point with the given places along named axes, and 0 elsewhere: float64 [D].

        Raises:
            ArgumentError: for an unknown axis.
        """
        names = [*self._space.axes]
        if len(names) != self.size:  # such as features of items
            names = [str(i) for i in range(self.size)]
        for name in start or {}:
            if name not in names:
                raise ArgumentError(f"start.{name}: unknown; there are: {', '.join(names)}")
        return torch.tensor([(start or {}).get(name, 0.0) for name in names], dtype=torch.float64)


def refuse_crossed(lower: float, upper: float) -> None:
    """Refuses a lower threshold above the upper one.

    Raises:
        ArgumentError: if so.
    """
    if lower > upper:
        raise ArgumentError(f"lower={lower}: must be at most upper={upper}")


def nearest(points: Tensor, places: Tensor) -> Tensor:
    """Finds the place nearest to each point; ties go to the last place.

    Args:
        points: float [n, D].
        places: float [m, D], m at least 1.

    Returns:
        int64 [n].

    Example:
        >>> nearest(torch.tensor([[0.9], [0.5]]), torch.tensor([[0.0], [1.0], [1.0]]))
        tensor([2, 2])
    """
    best = torch.full((len(points),), torch.inf, dtype=points.dtype)
    which = torch.zeros(len(points), dtype=torch.int64)
    for start in range(0, len(places), CHUNK):
        some = places[start : start + CHUNK].flip(0)  # min takes the first, flipped the last
        # Through a matrix product, equal distances would not come out equal.
        apart = torch.cdist(points, some, compute_mode="donot_use_mm_for_euclid_dist")
        least, index = apart.min(1)
        which = torch.where(least <= best, start + len(some) - 1 - index, which)
        best = torch.minimum(best, least)
    return which
