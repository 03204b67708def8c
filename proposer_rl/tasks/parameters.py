"""Distributions and bins of levels that are values of named parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

Number = int | float

SEED = "seed"
LARGEST_SEED = 2**31 - 1
STEP = 0.1  # standard deviation of an edit, as a share of a range
MOST_ITEMS = 1_000_000  # bins that curricula can remember one by one
MOST_BINS = 256  # along an axis, for readers of runs
MOST_COMBINATIONS = LARGEST_WHOLE = 2**63 - 1
LARGEST = torch.finfo(torch.float32).max


@dataclass(frozen=True)
class Bins:
    """Equally likely parts of a parameter's range, or single values.

    Attributes:
        low, high: ends of each part, float64 or int64 [n], equal for a single value. Whole numbers
            include both ends.
        log: whether values are drawn, moved and compared by their logarithms.
    """

    low: Tensor
    high: Tensor
    log: bool = field(default=False, kw_only=True)

    @property
    def middles(self) -> list[Any]:
        """Returns the middle value of each part."""
        return self.off_scale(self.centres).tolist() if self.wide else self.low.tolist()

    def on_scale(self, values: Tensor) -> Tensor:
        """Returns values as they are, or on a logarithmic scale their logarithms."""
        return values.double().clamp_min(0).log() if self.log else values

    def off_scale(self, places: Tensor) -> Tensor:
        """Returns the values at places on the scale; the inverse of :meth:`on_scale`."""
        return places.exp().clamp(self.low[0], self.high[-1]) if self.log else places

    def named(self, values: Tensor) -> list[Any]:
        """Returns values [n] as a loop gets them: numbers, or the choices that they stand for."""
        return values.tolist()

    def means(self, name: str, values: Tensor) -> dict[str, Tensor]:
        """Returns the mean of values [K, P] on the scale, [K], under the parameter's name."""
        return {name: self.off_scale(self.on_scale(values.double()).mean(-1))}

    @property
    def texts(self) -> list[str]:
        """Returns names of the parts, with enough digits to tell them apart."""
        texts = self._names(4)
        return texts if len({*texts}) == len(texts) else self._names(17)

    def _names(self, digits: int) -> list[str]:
        ends = zip(self.low.tolist(), self.high.tolist(), strict=True)
        return [
            f"{a:.{digits}g}" if a == b else f"{a:.{digits}g} to {b:.{digits}g}" for a, b in ends
        ]

    @cached_property
    def wide(self) -> bool:
        """Returns whether any part is more than a single value."""
        return bool((self.high > self.low).any())

    @property
    def centres(self) -> Tensor:
        """Returns the middle of each part on the scale, float64 [n]."""
        return (self.on_scale(self.low) + self.on_scale(self.high)).double() / 2

    @cached_property
    def borders(self) -> Tensor:
        """Returns the borders between neighbouring parts, float64 [n - 1]."""
        return (self.high[:-1] + self.low[1:]).double() / 2

    @cached_property
    def scale(self) -> tuple[float, float]:
        """Returns the place on the scale of coordinate -1, and the distance to that of 1."""
        ends = self.centres
        if len(ends) == 1:
            ends = self.on_scale(torch.cat([self.low, self.high])).double()
        return float(ends[0]), float(ends[-1] - ends[0])

    def draw(self, index: Tensor, generator: torch.Generator) -> Tensor:
        """Draws a value from each of the parts with these numbers, int64 [P]: [P]."""
        low, high = self.low[index], self.high[index]
        if not self.wide:
            return low
        share = torch.rand(len(index), generator=generator, dtype=torch.float64)
        if low.is_floating_point():
            inside = self.on_scale(low).lerp(self.on_scale(high), share)
            return inside.exp().clamp(low, high) if self.log else inside
        return low + (share * (high - low + 1)).long()

    def at(self, share: Tensor) -> Tensor:
        """Returns values [*B] at shares of the whole range, float64 [*B] from 0 to 1."""
        if self.wide and self.low.is_floating_point():
            low, high = self._ends
            return self.off_scale(low.lerp(high, share))
        values = torch.arange(int(self.low[0]), int(self.high[-1]) + 1) if self.wide else self.low
        return values[(share * len(values)).long().clamp(max=len(values) - 1)]

    def share(self, values: Tensor) -> Tensor:
        """Returns shares of the range, float64 [*B], at which :meth:`at` returns values [*B]."""
        if self.wide and self.low.is_floating_point():
            low, high = self._ends
            return (self.on_scale(values.double()) - low) / (high - low)
        if self.wide:
            return (values - self.low[0] + 0.5) / (self.high[-1] - self.low[0] + 1)
        return (torch.searchsorted(self.low, values) + 0.5) / len(self.low)

    def moved(self, old: Tensor, noise: Tensor) -> Tensor:
        """Returns values [n] moved within the range by a tenth of it times noise, float64 [n].

        Whole numbers and single values move by one at least.
        """
        if not self.wide:
            line = self.low.double()
            place = (line - old.unsqueeze(-1)).abs().argmin(-1)
            return self.low[(place + _one_at_least(noise, len(line))).clamp(0, len(line) - 1)]
        low, high = self._ends
        if self.low.is_floating_point():
            moved = self.on_scale(old) + noise * STEP * (high - low)
            return self.off_scale(moved.clamp(low, high))
        return (old + _one_at_least(noise, float(high - low))).clamp(low, high)

    def between(self, a: Tensor, b: Tensor, share: Tensor, noise: Tensor) -> Tensor:
        """Returns values [n] at shares, float64 [n], of the way from a to b, with noise.

        Noise, float64 [n], is in shares of the whole range. Whole numbers are rounded, and single
        values are the nearest of those that there are.
        """
        if not self.wide:
            start, end = (torch.searchsorted(self.low, one).double() for one in (a, b))
            last = len(self.low) - 1
            place = start.lerp(end, share) + noise * last
            return self.low[place.round().long().clamp(0, last)]
        low, high = (end.item() for end in self._ends)
        start, end = (self.on_scale(one.double()) for one in (a, b))
        value = start.lerp(end, share) + noise * (high - low)
        value = (value if self.low.is_floating_point() else value.round()).to(a).clamp(low, high)
        return self.off_scale(value)

    def columns(self, values: Tensor, scaled: Tensor) -> Tensor:
        """Returns a belief's inputs for values [*B], from -1 to 1: float64 [*B, c].

        Args:
            values: on the CPU.
            scaled: their coordinates; see :meth:`ParameterSpace.locate`.
        """
        return scaled.unsqueeze(-1)

    def below(self, ends: Tensor) -> Tensor:
        """Returns the probability of a value of at most each of some ends, float64 [n]."""
        low, high = (self.on_scale(end).double() for end in (self.low, self.high))
        if self.wide and not self.low.is_floating_point():  # a whole number has a width of 1
            low, high = low - 0.5, high + 0.5
        beyond = self.on_scale(ends.double()).unsqueeze(-1) - low
        inside = (beyond / (high - low)).clamp(0, 1)
        return torch.where(high > low, inside, (beyond >= 0).double()).mean(-1)

    def shares(self, of: Bins) -> Tensor:
        """Returns the share of other bins' values in each of these parts, float64 [n].

        Values beyond the first or last part, or between single values, count for the nearest part.
        """
        ends = of.below(self.borders)
        return torch.cat([torch.zeros(1), ends, torch.ones(1)]).diff()

    @cached_property
    def _ends(self) -> tuple[Tensor, Tensor]:
        """Returns the lowest and the highest place on the scale."""
        return self.on_scale(self.low[0]), self.on_scale(self.high[-1])

    def __str__(self) -> str:
        text = " or ".join(self._names(6))
        return f"{text} (log scale)" if self.log and self.wide else text


@dataclass(frozen=True)
class Law(Bins):
    """Any distribution on a part of a parameter's range.

    Attributes:
        quantile: function of probabilities, float64 [n], to the quantiles [n].
        cumulative: function of values [n] to the probabilities of at most each, float64 [n].
        name: of the distribution.
    """

    quantile: Callable[[Tensor], Tensor]
    cumulative: Callable[[Tensor], Tensor]
    name: str

    def draw(self, index: Tensor, generator: torch.Generator) -> Tensor:
        """Draws values [P], and moves those beyond the ends to them."""
        share = torch.rand(len(index), generator=generator, dtype=torch.float64)
        return self.quantile(share).clamp(self.low, self.high)

    def below(self, ends: Tensor) -> Tensor:
        """Returns the probability of a value of at most each of some ends, float64 [n]."""
        return self.cumulative(ends)

    def __str__(self) -> str:
        return self.name


def points(values: Sequence[Number]) -> Bins:
    """Returns bins that are single values; whole numbers, if all of them are.

    Raises:
        ValueError: if they do not rise, or do not fit into float32 or int64.
    """
    whole = all(isinstance(value, int) for value in values)
    largest = LARGEST_WHOLE if whole else LARGEST
    if not all(abs(value) <= largest for value in values):
        raise ValueError(f"values={list(values)} must be finite, and at most {largest:g} in size")
    line = torch.tensor(values, dtype=torch.int64 if whole else torch.float64)
    if (line.diff() <= 0).any():
        raise ValueError(f"values={list(values)} must rise")
    return Bins(line, line)


def intervals(low: float, high: float, count: int = 1, log: bool = False) -> Bins:
    """Returns equal parts of a range, within which values are uniform, or their logarithms are.

    Raises:
        ValueError: if the ends do not rise, do not fit into float32, or with ``log`` are not
            above 0.
    """
    if not -LARGEST <= low < high <= LARGEST or (log and low <= 0):
        above = ", and above 0 on a logarithmic scale" * log
        raise ValueError(
            f"low={low} must be below high={high}, and both finite, at most {LARGEST:g} in size"
            + above
        )
    edges = torch.linspace(low, high, count + 1, dtype=torch.float64)
    if log:
        edges = torch.from_numpy(np.geomspace(low, high, count + 1))
    return Bins(edges[:-1], edges[1:], log=log)


class ParameterSpace:
    """All combinations of some parameters' bins, as a distribution of levels and a space.

    A level is a tensordict with an entry for each parameter, float64 or int64. A seeded one has the
    ``seed`` of its reset, int64, with which all of its episodes begin alike.

    Args:
        bins: of each parameter, by name.
        seeded: whether levels have seeds.
        seeds: range from which they are drawn.
        device: of the levels.

    Raises:
        ValueError: if there are more combinations of bins than int64 can count.

    Example:
        >>> space = ParameterSpace({"gravity": points([5, 10]), "force": intervals(2.0, 18.0, 4)})
        >>> space.size, list(space.sample(3, torch.Generator()).keys())
        (8, ['gravity', 'force', 'seed'])
    """

    def __init__(
        self,
        bins: Mapping[str, Bins],
        seeded: bool = True,
        seeds: range = range(LARGEST_SEED),
        device: torch.device | str = "cpu",
    ) -> None:
        self.bins, self._seeded, self._seeds = dict(bins), seeded, seeds
        self._device = torch.device(device)
        self.axes = {name: part.middles for name, part in self.bins.items()}
        scales = [part.scale for part in self.bins.values()]
        self._scales = torch.tensor(scales, dtype=torch.float64).reshape(-1, 2).mT
        self.size = math.prod(len(values) for values in self.axes.values())
        if self.size > MOST_COMBINATIONS:
            raise ValueError(
                f"parameters: {self.size:,} combinations of their bins cannot be numbered; set "
                "fewer bins, or none where a method needs none"
            )

    @property
    def coordinates(self) -> Tensor:
        """Returns the coordinates of bins, [N, D]: -1 to 1, or 0 along an axis of one bin."""
        lines = [_unit(part.centres, *part.scale) for part in self.bins.values()]
        if not lines:
            return torch.zeros(1, 0)
        return torch.cartesian_prod(*lines).reshape(self.size, len(lines)).float()

    def locate(self, levels: TensorDictBase) -> Tensor:
        """Returns the :attr:`coordinates` of levels [*B]: float32 [*B, D] on the CPU.

        Along an axis of one bin they go from -1 to 1.
        """
        return self._scaled(levels).float()

    def inputs(self, levels: TensorDictBase) -> Tensor:
        """Returns a belief's inputs for levels [*B]: float64 [*B, D] on the CPU."""
        where = self._scaled(levels)
        places = zip(self.bins.items(), where.unbind(-1), strict=True)
        known = [part.columns(levels[name].cpu(), own) for (name, part), own in places]
        return torch.cat(known, -1) if known else where

    def _scaled(self, levels: TensorDictBase) -> Tensor:
        """Returns the coordinates of levels [*B] in float64: [*B, D] on the CPU."""
        if not self.bins:
            return torch.zeros(*levels.batch_size, 0, dtype=torch.float64)
        lines = [part.on_scale(levels[name].double()) for name, part in self.bins.items()]
        return _unit(torch.stack(lines, -1).cpu(), *self._scales)

    def items(self, levels: TensorDictBase) -> Tensor | None:
        """Returns the bins of levels [*B] if all are single values: int64 [*B] on the CPU.

        None if levels of a bin can differ, or there are too many bins to remember one by one.
        """
        if self.size > MOST_ITEMS or any(part.wide for part in self.bins.values()):
            return None
        number = torch.zeros(levels.batch_size, dtype=torch.int64)
        for name, part in self.bins.items():
            number = number * len(part.low) + torch.searchsorted(part.low, levels[name].cpu())
        return number

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator]) -> TensorDict:
        """Draws levels [K, P] from bins, int64 [K, P]; generator k draws those of replica k."""
        copies = [self._draw(own, g) for own, g in zip(choices, generators, strict=True)]
        return torch.stack(copies)

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Draws levels [count] uniformly from the bins."""
        return self._draw(torch.randint(self.size, (count,), generator=generator), generator)

    def shares(self, other: ParameterSpace) -> Tensor:
        """Returns the share of another distribution's levels in each of these bins, float [N]."""
        shares = torch.ones(1, dtype=torch.float64)
        for name, bins in other.bins.items():
            shares = torch.outer(shares, self.bins[name].shares(bins)).flatten()
        return shares.float()

    def _draw(self, choices: Tensor, generator: torch.Generator) -> TensorDict:
        places = self._unravelled(choices)
        level = {name: part.draw(places[name], generator) for name, part in self.bins.items()}
        seeds = self._drawn_seeds(choices.shape, generator)
        return TensorDict({**level, **seeds}, choices.shape, device=self._device)

    def _unravelled(self, choices: Tensor) -> dict[str, Tensor]:
        """Returns the bin along each axis of combinations int64 [P], by name: int64 [P]."""
        places, nothing = {}, torch.zeros_like(choices)
        for name, values in reversed(self.axes.items()):  # the last axis runs fastest
            size = len(values)
            places[name] = choices % size if size > 1 else nothing
            choices = choices // size if size > 1 else choices
        return places

    def at(self, points: Tensor, generators: Sequence[torch.Generator]) -> TensorDict:
        """Returns levels [K, P] at points of the box [-1, 1]^D, which the whole ranges span.

        Single values of a parameter have equal parts of its side.

        Args:
            points: float [K, P, D].
            generators: of each row's seeds.
        """
        shares = (points.double() + 1) / 2
        level = {name: part.at(shares[..., i]) for i, (name, part) in enumerate(self.bins.items())}
        seeds = [self._drawn_seeds(points.shape[1:2], g) for g in generators]
        drawn = {key: torch.stack([one[key] for one in seeds]) for key in seeds[0]}
        return TensorDict({**level, **drawn}, points.shape[:2], device=self._device)

    def between(
        self, a: TensorDictBase, b: TensorDictBase, noise: float, generator: torch.Generator
    ) -> TensorDict:
        """Returns levels [n] at random places between pairs of levels [n].

        Args:
            a: levels of the space.
            b: levels of the space, or of a target.
            noise: standard deviation along each parameter, in shares of its range.
            generator: on the CPU.
        """
        share = torch.rand(a.batch_size, generator=generator, dtype=torch.float64)
        level = {}
        for name, part in self.bins.items():
            off = noise * torch.randn(a.batch_size, generator=generator, dtype=torch.float64)
            level[name] = part.between(a[name].cpu(), b[name].cpu(), share, off)
        seeds = self._drawn_seeds(a.batch_size, generator)
        return TensorDict({**level, **seeds}, a.batch_size, device=self._device)

    def place(self, levels: TensorDictBase) -> Tensor:
        """Returns points, float64 [*B, D], at which :meth:`at` returns levels [*B]."""
        shares = [part.share(levels[name].cpu()) for name, part in self.bins.items()]
        return 2 * torch.stack(shares, -1).double() - 1

    def edit(
        self, levels: TensorDictBase, count: int, generators: Sequence[torch.Generator]
    ) -> TensorDict:
        """Returns levels [K, n] after so many steps, each along one random parameter.

        The step's standard deviation is a tenth of the range, which is not left. Whole numbers and
        single values move by one at least.
        """
        return torch.stack(
            [self._edited(own, count, g) for own, g in zip(levels, generators, strict=True)]
        )

    def _edited(self, levels: TensorDictBase, count: int, generator: torch.Generator) -> TensorDict:
        levels, shape = levels.cpu().clone(), levels.batch_size
        for _ in range(count):
            which = torch.randint(len(self.bins), shape, generator=generator)
            noise = torch.randn(shape, generator=generator, dtype=torch.float64)
            for i, (name, part) in enumerate(self.bins.items()):
                old = levels[name]
                levels[name] = part.moved(old, noise).where(which == i, old)
        return levels.to(self._device)

    def __str__(self) -> str:
        return "; ".join(f"{name} {part}" for name, part in self.bins.items()) or "any level"

    def _drawn_seeds(self, shape: torch.Size, generator: torch.Generator) -> dict[str, Tensor]:
        if not self._seeded:
            return {}
        ends = self._seeds.start, self._seeds.stop
        return {SEED: torch.randint(*ends, shape, generator=generator)}


def _unit(places: Tensor, first: Tensor | float, reach: Tensor | float) -> Tensor:
    """Returns places [*B] scaled to -1 at the first and 1 at its reach; 0 without a reach."""
    return torch.where(torch.as_tensor(reach) > 0, 2 * (places - first) / reach - 1, 0 * places)


def _one_at_least(noise: Tensor, reach: float) -> Tensor:
    """Returns steps int64 [n] of a tenth of a reach times noise, and of one at least."""
    steps = (noise * max(STEP * reach, 1)).round()
    return steps.where(steps != 0, noise.sign()).long()
