"""The settings of parameters that make levels: the range of each, and what of it is the target."""

# Annotations are objects here, not texts: settings of other modules inherit the fields.
import re
import warnings
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import scipy  # which loads its statistics, a second of work, where they are asked for
import torch
from annotated_types import Ge, Le, Len
from torch import Tensor

from proposer_rl.settings import ArgumentError, Positive, arguments, settings
from proposer_rl.tasks.parameters import (
    MOST_BINS,
    SEED,
    Bins,
    Law,
    Number,
    ParameterSpace,
    intervals,
    points,
)

# Columns of the table of training, where parameters have one each, too; beside PPO's ``loss_...``.
OF_PPO = {"entropy", "kl_approx", "clip_fraction", "explained_variance", "grad_norm"}
RESERVED = {SEED, "updates", "train_success", "train_return", *OF_PPO}


@settings
class RangeSettings:
    """A number that differs between levels.

    Either ``values``, each of which is a bin, or a range from ``low`` to ``high`` in ``bins`` equal
    parts, within which it is drawn uniformly; without ``bins`` in one.

    Attributes:
        values: rising; whole numbers, if all are.
        low, high, bins: of a range.
        target: what is to be mastered: a number; of ``values`` one or several, equally likely; of a
            range also [from, to]. Or a mapping: rising ``values``, with their ``weights``, which
            need not add up to one; or a ``distribution`` of :mod:`scipy.stats` by its name, with
            its arguments.
    """

    values: Annotated[list[Number], Len(1, MOST_BINS)] | None = None
    low: float | None = None
    high: float | None = None
    bins: Annotated[int, Ge(1), Le(MOST_BINS)] | None = None
    target: Number | Annotated[list[Number], Len(1)] | dict[str, Any]

    def space_bins(self) -> Bins:
        """The bins of the parameter.

        Raises:
            ValueError: if it has neither values nor a range, both, or they do not rise.
        """
        low, high, bins = self.low, self.high, self.bins
        if self.values is not None:
            if (low, high, bins) != (None, None, None):
                raise ValueError("either values, or low, high and bins")
            return points(self.values)
        if low is None or high is None:
            raise ValueError("needs values, or low, high and perhaps bins")
        return intervals(low, high, bins or 1)

    def target_bins(self) -> Bins:
        """What of the parameter the Solver is to master.

        Raises:
            ValueError: if it is no part of a line, nor a distribution on it.
        """
        if isinstance(self.target, dict):
            return self._law(**self.target)
        target = self.target if isinstance(self.target, list) else [self.target]
        if self.values is not None or len(target) == 1:
            return self._points(target, "target")
        if len(target) > 2 or not target[0] < target[1]:
            raise ValueError(f"target={target} must be a number or [from, to]")
        return intervals(target[0], target[1])

    def _points(self, values: list[Number], key: str) -> Bins:
        """Single values, of the type of the space's."""
        kind, single = self.space_bins().low.dtype, points(values, key).low
        if kind == torch.int64 and single.dtype != kind:
            raise ValueError(f"{key}={values} must be whole, as values={self.values} are")
        if self.values is not None and set(values) - set(self.values):
            raise ValueError(f"{key}={values}: must be among values={self.values}")
        return Bins(single.to(kind), single.to(kind))

    def _law(self, distribution: str | None = None, **given: Any) -> Law:
        if distribution is None:
            try:
                read = arguments(weighted_points, given, ("line",))
            except ArgumentError as error:
                raise ValueError(f"target.{error}") from error
            line = self._points(read["values"], "target.values").low
            return weighted_points(line, **read)
        if self.values is not None:
            raise ValueError("target.distribution: of a range only; give weights of values")
        space = self.space_bins()
        return _named(distribution, given, space.low[:1], space.high[-1:])


def weighted_points(
    line: Tensor, values: Annotated[list[Number], Len(1)], weights: list[Positive]
) -> Law:
    """Single values, also as a tensor [n], that are more or less likely.

    Raises:
        ValueError: if there is not a weight for each.
    """
    if len(weights) != len(line):
        raise ValueError(f"target.weights={weights}: must be one for each of {len(line)} values")
    summed = torch.tensor(weights, dtype=torch.float64).cumsum(0)
    reached = summed / summed[-1]

    def quantile(shares: Tensor) -> Tensor:
        return line[torch.searchsorted(reached, shares, right=True)]

    def cumulative(ends: Tensor) -> Tensor:
        known = torch.cat([torch.zeros(1, dtype=torch.float64), reached])
        return known[torch.searchsorted(line.double(), ends.double(), right=True)]

    pairs = zip(values, weights, strict=True)
    name = " or ".join(f"{value:g} (weight {weight:g})" for value, weight in pairs)
    return Law(line[:1], line[-1:], quantile, cumulative, name)


def spaces(
    parameters: Mapping[str, RangeSettings], **seeds: Any
) -> tuple[ParameterSpace, ParameterSpace]:
    """The space of some parameters by name, and their target.

    Args:
        parameters: by name.
        seeds: as of :class:`~proposer_rl.tasks.parameters.ParameterSpace`.

    Raises:
        ValueError: naming the key, for a name or a value that is not allowed.
    """
    bins, target = {}, {}
    for name, given in parameters.items():
        try:
            if name in RESERVED or name.startswith("loss_"):
                raise ValueError("is a column of training.csv; choose another name")
            if not re.fullmatch(r"\w[\w .-]*", name):
                raise ValueError("must be a name of letters, digits, spaces, dots and dashes")
            bins[name], target[name] = given.space_bins(), given.target_bins()
        except ValueError as error:
            raise ValueError(f"parameters.{name}: {error}") from error
        if _inside(target[name], bins[name]) < 0.5:  # a typing error, or extrapolation
            warnings.warn(
                f"parameters.{name}: most of the target, {target[name]}, lies outside of "
                f"low={given.low:g} to high={given.high:g}: is that meant?",
                stacklevel=2,
            )
    return ParameterSpace(bins, **seeds), ParameterSpace(target, **seeds)


def _inside(target: Bins, space: Bins) -> float:
    """How much of a target lies within the ends of a space."""
    low, high = space.low[:1].double(), space.high[-1:].double()
    below = torch.nextafter(low, low - 1)
    return float(target.below(high) - target.below(below))


def _named(name: str, given: Mapping[str, Any], low: Tensor, high: Tensor) -> Law:
    """A continuous distribution of scipy's within a range."""
    kind = getattr(scipy.stats, str(name), None)
    if not isinstance(kind, scipy.stats.rv_continuous):
        raise ValueError(
            f"target.distribution={name}: must be a continuous distribution of scipy.stats, such "
            "as norm, uniform or loguniform"
        )
    try:
        frozen = kind(**given)
        fits = bool(frozen.median() == frozen.median())
    except (TypeError, ValueError) as error:
        raise ValueError(f"target: {name} of scipy.stats: {error}") from error
    text = f"{name}({', '.join(f'{key}={value}' for key, value in given.items())})"
    if not fits:
        raise ValueError(f"target: {text} is no distribution: see scipy.stats.{name}")

    def of(function: Any, numbers: Tensor) -> Tensor:
        return torch.as_tensor(function(numbers.numpy()), dtype=torch.float64)

    quantile, cumulative = partial(of, frozen.ppf), partial(of, frozen.cdf)
    return Law(low, high, quantile, cumulative, text)
