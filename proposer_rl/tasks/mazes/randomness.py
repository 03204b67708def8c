"""Random numbers for many candidates at once, from one generator or from one for each group."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Generators = torch.Generator | None | Sequence[torch.Generator]


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
        """Uniform numbers in [0, 1), float32 ``[rows, C]``."""
        return self._columns(lambda n, g: torch.rand(rows, n, generator=g, device=self.device))

    def randint(self, high: int) -> Tensor:
        """Uniform whole numbers in 0 ... high - 1, int64 ``[1, C]``."""
        return self._columns(
            lambda n, g: torch.randint(high, (1, n), generator=g, device=self.device)
        )

    def of(self, kept: Tensor) -> Draws:
        """The same for some of the candidates, whose ascending indices are given, int64 ``[A]``."""
        return Draws(self._generators, self._group[kept.cpu()], self.device)

    def _columns(self, draw: Callable[[int, torch.Generator | None], Tensor]) -> Tensor:
        if not isinstance(self._generators, Sequence):
            return draw(len(self._group), self._generators)
        counts = self._group.bincount(minlength=len(self._generators)).tolist()
        drawn = [draw(n, g) for n, g in zip(counts, self._generators, strict=True)]
        place = self._group.argsort(stable=True).argsort()  # of each candidate among the drawn
        return torch.cat(drawn, 1).index_select(1, place.to(self.device))
