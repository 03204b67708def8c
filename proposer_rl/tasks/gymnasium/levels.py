"""Levels: the values of an environment's parameters, and the seed of its reset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.tasks.gymnasium.settings import Number, ParameterSettings

SEED = "seed"
LARGEST_SEED = 2**31 - 1


class Bins(NamedTuple):
    """Parts of a parameter's line that are equally likely.

    Attributes:
        low, high: ends of each part, float64 or int64 [n]; equal where the part is a single value.
    """

    low: Tensor
    high: Tensor

    @property
    def middles(self) -> list[Number]:
        """The value that stands for each part."""
        return self.low.lerp(self.high, 0.5).tolist() if self.wide else self.low.tolist()

    @property
    def wide(self) -> bool:
        """Whether the parts are more than single values."""
        return bool((self.high > self.low).any())

    def draw(self, index: Tensor, generator: torch.Generator) -> Tensor:
        """A value of each of the parts int64 [P]: [P]."""
        low, high = self.low[index], self.high[index]
        if not self.wide:
            return low
        return low.lerp(high, torch.rand(len(index), generator=generator, dtype=low.dtype))

    def shares(self, of: Bins) -> Tensor:
        """Which of these parts values of other parts lie in, float64 [n].

        What lies beyond the first or the last part, or between single values, counts for the
        nearest part.
        """
        total = torch.zeros(len(self.low), dtype=torch.float64)
        for low, high in zip(of.low, of.high, strict=True):
            if high == low:
                apart = torch.maximum(self.low - low, low - self.high).clamp_min(0)
                total[apart.argmin()] += 1
            else:
                inner = self.high[:-1].clamp(low, high)
                ends = torch.cat([low.view(1), inner, high.view(1)])
                total += ends.diff() / (high - low)
        return total / len(of.low)


def space_bins(settings: ParameterSettings) -> Bins:
    """The bins of a parameter.

    Raises:
        ValueError: if it has neither values nor a range, both, or they do not rise.
    """
    range_ = (settings.low, settings.high, settings.bins)
    if settings.values is not None:
        if any(number is not None for number in range_):
            raise ValueError("either values, or low, high and bins")
        return _single("values", settings.values)
    low, high, bins = range_
    if low is None or high is None or bins is None:
        raise ValueError("needs values, or low, high and bins")
    if not low < high:
        raise ValueError(f"low={low} must be below high={high}")
    edges = torch.linspace(low, high, bins + 1, dtype=torch.float64)
    return Bins(edges[:-1], edges[1:])


def target_bins(settings: ParameterSettings) -> Bins:
    """What of a parameter the Solver is to master.

    Raises:
        ValueError: if it is no part of a line.
    """
    target = settings.target if isinstance(settings.target, list) else [settings.target]
    kind = space_bins(settings).low.dtype
    if settings.values is not None or len(target) == 1:
        points = _single("target", target)
        if kind == torch.int64 and points.low.dtype != kind:
            raise ValueError(f"target={target} must be whole, as values={settings.values} are")
        return Bins(*(end.to(kind) for end in points))
    if len(target) > 2 or not target[0] < target[1]:
        raise ValueError(f"target={target} must be a number or [from, to]")
    low, high = torch.tensor(target, dtype=kind)
    return Bins(low.view(1), high.view(1))


def _single(key: str, values: Sequence[Number]) -> Bins:
    whole = all(isinstance(value, int) for value in values)
    points = torch.tensor(values, dtype=torch.int64 if whole else torch.float64)
    if (points.diff() <= 0).any():
        raise ValueError(f"{key}={list(values)} must rise")
    return Bins(points, points)


class ParameterSpace:
    """The levels of all combinations of some parameters' bins; a distribution and a space.

    A level is a tensordict with an entry for each parameter, float64 or int64, and the ``seed`` of
    its reset, int64: two episodes on it begin alike.

    Args:
        bins: of each parameter, by name.
    """

    def __init__(self, bins: Mapping[str, Bins]) -> None:
        self.bins = dict(bins)
        self.axes = {name: part.middles for name, part in self.bins.items()}
        self.size = reduce(lambda count, values: count * len(values), self.axes.values(), 1)

    @property
    def coordinates(self) -> Tensor:
        """Of each bin, from -1 to 1 along every axis (0 along one of a single bin): [N, D]."""
        lines = [_scaled(values) for values in self.axes.values()]
        return torch.cartesian_prod(*lines).reshape(self.size, len(lines)).float()

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator]) -> TensorDict:
        """Levels [K, P] of bins, int64 [K, P]; copy k's from generator k."""
        copies = [self._draw(own, g) for own, g in zip(choices, generators, strict=True)]
        return torch.stack(copies)

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Levels [count], evenly from the bins."""
        return self._draw(torch.randint(self.size, (count,), generator=generator), generator)

    def shares(self, other: ParameterSpace) -> Tensor:
        """Which of these bins the levels of another distribution lie in, float [N]."""
        parts = [self.bins[name].shares(bins) for name, bins in other.bins.items()]
        return reduce(lambda all_, part: torch.outer(all_, part).flatten(), parts).float()

    def _draw(self, choices: Tensor, generator: torch.Generator) -> TensorDict:
        places = torch.unravel_index(choices, [len(values) for values in self.axes.values()])
        level = {
            name: part.draw(place, generator)
            for (name, part), place in zip(self.bins.items(), places, strict=True)
        }
        seeds = torch.randint(LARGEST_SEED, choices.shape, generator=generator)
        return TensorDict({**level, SEED: seeds}, choices.shape)


def _scaled(values: Sequence[Number]) -> Tensor:
    points = torch.tensor(values, dtype=torch.float64)
    reach = points[-1] - points[0]
    return 2 * (points - points[0]) / reach - 1 if reach > 0 else 0 * points
