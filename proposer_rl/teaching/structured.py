"""Levels of any structure, which a function makes from named parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.tasks.parameters import ParameterSpace
from proposer_rl.teaching.spaces import (
    DRAWN,
    Features,
    LevelSpace,
    Parameters,
    Ranges,
    in_default_dtype,
)

Make = Callable[[TensorDictBase, torch.Generator], Any]


class MadeLevels(Parameters):
    """Levels that a function makes from parameters, such as terrains from slope and roughness.

    Curricula see the parameters: their bins, the target, and small edits, after which the level is
    made anew. The loop gets only what the function returns.

    Args:
        ranges: the values of each parameter, by name; see :class:`Parameters`.
        make: ``make(values, generator)`` returns levels [n] for a tensordict of values [n]: a
            tensor or a tensordict. Real numbers are in torch's default dtype on both sides.
        features: ``features(levels)`` returns numbers [n, F] that describe levels [n], each about
            -1 to 1; None for the parameters.
        bins, target, named: see :class:`Parameters`.

    Raises:
        ArgumentError: see :class:`Parameters`.

    Example:
        >>> def rows(values, generator):
        ...     x = torch.linspace(0, 1, 5)
        ...     return values["slope"].unsqueeze(-1) * x + torch.rand(len(values), 5)
        >>> space = MadeLevels({"slope": (0.0, 8.0)}, rows, target={"slope": 8.0})
        >>> space.size, space.given(space.sample(3, torch.Generator())).shape
        (8, torch.Size([3, 5]))
    """

    def __init__(
        self,
        ranges: Ranges,
        make: Make,
        *,
        features: Features | None = None,
        bins: int | Mapping[str, int] = 8,
        target: Ranges | None = None,
        named: Mapping[str, Ranges] | None = None,
    ) -> None:
        super().__init__(ranges, bins=bins, target=target, named=named)
        self._make, self._features = make, features
        parts = {name: _Made(part, self) for name, part in self._parts.items()}
        self.distributions = {"all": self, **parts}

    def made(self, values: TensorDictBase, generator: torch.Generator) -> TensorDict:
        """Makes levels [n] from values of the parameters [n], and stores the values with them."""
        kept = values.select(*self.bins)
        levels = self._make(in_default_dtype(kept.clone()), generator)
        return TensorDict({**kept, DRAWN: in_default_dtype(levels)}, kept.batch_size)

    def inputs(self, levels: TensorDictBase) -> Tensor:
        """Returns the inputs of a belief for levels: their features, or else their parameters."""
        return super().inputs(levels) if self._features is None else self.features(levels)

    def given(self, levels: TensorDictBase) -> Any:
        """Returns levels [*B] as the function made them."""
        return levels[DRAWN]

    def rows(self, levels: TensorDictBase) -> list[Any]:
        """Returns levels [n] as a list."""
        return LevelSpace.rows(self, levels)

    def at(self, points: Tensor, generators: Sequence[torch.Generator]) -> TensorDict:
        """Makes levels [K, P] at points of the box that the ranges span."""
        values = zip(super().at(points, generators), generators, strict=True)
        return torch.stack([self.made(own, g) for own, g in values])

    def between(
        self, a: TensorDictBase, b: TensorDictBase, noise: float, generator: torch.Generator
    ) -> TensorDict:
        """Makes levels [n] from values at random places between those of ``a`` and ``b``."""
        return self.made(super().between(a, b, noise, generator), generator)

    def _draw(self, choices: Tensor, generator: torch.Generator) -> TensorDict:
        return self.made(super()._draw(choices, generator), generator)

    def _edited(self, levels: TensorDictBase, count: int, generator: torch.Generator) -> TensorDict:
        return self.made(super()._edited(levels, count, generator), generator)


class _Made(ParameterSpace):
    """A named distribution of a space of made levels."""

    def __init__(self, bins: Any, whole: MadeLevels) -> None:
        super().__init__(bins, seeded=False)
        self._whole = whole

    def _draw(self, choices: Tensor, generator: torch.Generator) -> TensorDict:
        return self._whole.made(super()._draw(choices, generator), generator)
