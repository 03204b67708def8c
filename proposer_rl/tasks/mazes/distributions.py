"""Distributions of mazes: a set of specifications, or a grid of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.generation import Generators, generate_levels
from proposer_rl.tasks.mazes.levels import Level, LevelSpec, shortest_path_length


class LevelDistribution:
    """Levels of specifications that are equally likely, numbered in their order.

    Making one proves that every specification can be met: it draws a level of each, from a
    generator of its own, so that it does not disturb any other random state.

    Args:
        specifications: Pairs (obstacle fraction, path length), at least one; see
            :class:`~proposer_rl.tasks.mazes.levels.LevelSpec`.
        mechanism: ``"uniform"`` or ``"path_first"``; see
            :func:`~proposer_rl.tasks.mazes.generation.generate_levels`.
        height: H, cells.
        width: W, cells.
        device: Where the levels are returned.

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
        """Returns obstacle fractions, float64, and path lengths, int64, of numbers ``[*B]``."""
        fractions, lengths = zip(*self.specifications, strict=True)
        return (
            torch.tensor(fractions, dtype=torch.float64, device=index.device)[index],
            torch.tensor(lengths, device=index.device)[index],
        )

    def generate(self, index: Tensor, generator: Generators = None) -> Level:
        """Draws a level of each numbered specification, int64 ``[*B]``, in their order: ``[*B]``.

        The generators are as in :func:`~proposer_rl.tasks.mazes.generation.generate_levels`.
        """
        fraction, length = self.decode(index.cpu())
        grid = (self.height, self.width)
        return generate_levels(fraction, length, *grid, self.mechanism, generator, self.device)

    def sample(
        self, batch_shape: int | Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Level:
        """Draws levels ``[*B]``, a number standing for ``[B]``, of random specifications."""
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
    """The M x N pairs of M obstacle fractions and N path lengths, numbered row by row.

    Number ``i * N + j`` stands for ``(obstacle_fractions[i], path_lengths[j])``.

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
        """Returns where levels [*B] lie, as :attr:`coordinates`: float32 [*B, 2] on the CPU.

        A goal that cannot be reached counts as far away as there are cells.
        """
        length = shortest_path_length(levels)
        moves = length.where(length >= 0, self.height * self.width)
        return torch.stack(self._scaled(levels.walls.float().mean((-2, -1)).cpu(), moves.cpu()), -1)

    def nearest(self, specifications: Sequence[LevelSpec]) -> Tensor:
        """Returns the number of the pair nearest to each of n specifications: int64 [n].

        Between equally near ones rounding decides. Pairs that the space does not have get the
        nearest that it has, also where they lie outside of it.
        """
        scaled = self._scaled(*zip(*specifications, strict=True))
        return torch.cdist(torch.stack(scaled, -1), self.coordinates).argmin(-1)

    def _scaled(self, *lines: Sequence[float] | Tensor) -> list[Tensor]:
        """Scales values to -1 to 1 along each axis; 0 where it has a single value."""
        scaled = []
        for values, axis in zip(lines, self.axes.values(), strict=True):
            known = torch.tensor(axis, dtype=torch.float32)
            middle, reach = (known.max() + known.min()) / 2, (known.max() - known.min()) / 2
            place = torch.as_tensor(values, dtype=torch.float32)
            scaled.append((place - middle) / reach if reach > 0 else torch.zeros_like(place))
        return scaled
