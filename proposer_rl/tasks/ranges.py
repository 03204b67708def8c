"""Reads ranges of parameters and their targets, from files and from Python.

A parameter is a continuous range, whole numbers, or choices. :func:`read_line` and
:class:`LineSettings` make bins of it, and :func:`read_part` of a part of it, such as the target.
"""

# Annotations are objects here, not texts: settings of other modules inherit the fields.
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from numbers import Real
from typing import Annotated, Any, Literal

import scipy  # whose functions are loaded where they are asked for
import torch
from annotated_types import Ge, Le, Len
from torch import Tensor
from torch.nn.functional import one_hot

from proposer_rl.settings import (
    ArgumentError,
    Positive,
    arguments,
    plain,
    settings,
    shown,
    within,
)
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

# Other columns of training.csv, which has one for each parameter; besides PPO's ``loss_...``.
OF_PPO = {"entropy", "kl_approx", "clip_fraction", "explained_variance", "grad_norm"}
RESERVED = {SEED, "updates", "train_success", "train_return", *OF_PPO}


@settings
class LineSettings:
    """Settings of a parameter's values.

    They are either ``values``, each of which is a bin, or a range from ``low`` to ``high`` in
    ``bins`` equal parts, which values are drawn from uniformly.

    Attributes:
        values: rising numbers; or texts, truth values and the like, in any order.
        low, high, bins: of a range.
        log: whether numbers are drawn, cut into equal parts, interpolated and compared by their
            logarithms.
    """

    values: Annotated[list[Any], Len(1, MOST_BINS)] | None = None
    low: float | None = None
    high: float | None = None
    bins: Annotated[int, Ge(1), Le(MOST_BINS)] | None = None
    log: bool = False

    def space_bins(self, count: int = 1) -> Bins:
        """Returns the bins, of which a range has the given count if the settings have none.

        Raises:
            ValueError: if there are neither values nor a range, or both; if they do not rise, or
                are not above 0 on a logarithmic scale.
        """
        low, high, bins = self.low, self.high, self.bins
        if self.values is not None and (low, high, bins) == (None, None, None):
            return choice_bins(self.values, self.log)
        if self.values is not None or low is None or high is None:
            raise ValueError("needs either values, or low, high and perhaps bins")
        return intervals(low, high, bins or count, self.log)


@settings
class RangeSettings(LineSettings):
    """Settings of a number that differs between levels, and of its target.

    Attributes:
        target: the part to be mastered: a number, or several that are equally likely; of a range,
            two numbers are ``[from, to]``. Or a mapping: ``values`` with their ``weights``, which
            need not add up to one; or ``distribution: norm`` with ``loc`` and ``scale`` for a
            normal distribution whose tails beyond the range lie at its ends.
    """

    values: Annotated[list[Number], Len(1, MOST_BINS)] | None = None
    target: Number | Annotated[list[Number], Len(1)] | dict[str, Any]

    def target_bins(self) -> Bins:
        """Returns the bins of the target.

        Raises:
            ValueError: if it is neither a part of the parameter nor a distribution on it.
        """
        line = self.space_bins()
        return read_part("target", target_in_file(self.target, line), line)

    @property
    def measured(self) -> dict[str, Any]:
        """Returns the settings that must be equal for results to be comparable, for JSON."""
        # Older runs lack these settings, and are comparable to runs that do not use them.
        new = ("log", "to")
        return {key: value for key, value in asdict(self).items() if key not in new or value}


@dataclass(frozen=True)
class Log:
    """A continuous range on a logarithmic scale, for :class:`~proposer_rl.Parameters`.

    Bins are equal in ratio, draws in a bin are log-uniform, and small edits, interpolation and a
    belief's inputs go by the logarithm.

    Attributes:
        low: above 0.
        high: above ``low``.

    Example:
        >>> import proposer_rl as prl
        >>> prl.Parameters({"friction": prl.Log(0.01, 1)}, bins=4).bins["friction"].texts
        ['0.01 to 0.03162', '0.03162 to 0.1', '0.1 to 0.3162', '0.3162 to 1']
    """

    low: float
    high: float


@dataclass(frozen=True)
class Labelled(Bins):
    """Bins of choices without an order, such as texts; a level has the place in their list.

    Attributes:
        labels: the choices.
    """

    labels: list[Any]

    @property
    def middles(self) -> list[Any]:
        """Returns the label of each part as a text."""
        return [" ".join(str(label).split()) for label in self.named(self.low)]

    def named(self, values: Tensor) -> list[Any]:
        """Returns the labels at places [n]."""
        return [self.labels[place] for place in values.tolist()]

    @property
    def texts(self) -> list[str]:
        """Returns the labels as texts, with their places if two are alike."""
        texts = self.middles
        alike = len({*texts}) < len(texts)
        return [f"{place}: {text}" for place, text in enumerate(texts)] if alike else texts

    def between(self, a: Tensor, b: Tensor, share: Tensor, noise: Tensor) -> Tensor:
        """Returns one of two choices each, b with a probability of the share."""
        return torch.where(share < 0.5, a, b)

    def means(self, name: str, values: Tensor) -> dict[str, Tensor]:
        """Returns the share of each label among values [K, P], [K], by ``name=label``."""
        shares = one_hot(values, len(self.labels)).double().mean(-2)
        return {f"{name}={text}": shares[..., i] for i, text in enumerate(self.texts)}

    def columns(self, values: Tensor, scaled: Tensor) -> Tensor:
        """Returns values [*B] one-hot, float64 [*B, c]."""
        return one_hot(values, len(self.labels)).double()

    def moved(self, old: Tensor, noise: Tensor) -> Tensor:
        """Returns another place for each of [n], chosen by noise, float64 [n]."""
        count = len(self.low)
        further = 1 + (noise.abs() * 1e6).long() % max(count - 1, 1)
        return (old + further) % count

    def __str__(self) -> str:
        return " or ".join(self.middles)


def choice_bins(values: list[Any], log: bool = False) -> Bins:
    """Returns a bin for each of some rising numbers, or for each choice of any other kind.

    Raises:
        ValueError: for numbers that do not rise or are too large, texts or truth values that occur
            twice, or a logarithmic scale of anything but numbers above 0.
    """
    numbers = all(map(is_real, values))
    if log and not (numbers and values[0] > 0):
        raise ValueError(f"log=True: needs numbers above 0, not values={shown(values)}")
    if numbers:
        return replace(points(values), log=log)
    simple = [value for value in values if isinstance(value, str | int | float)]
    if len({*simple}) < len(simple):
        raise ValueError(f"values={shown(values)}: must have each once")
    places = torch.arange(len(values))
    return Labelled(places, places, values)


def read_line(key: str, given: Any, count: int = 1) -> Bins:
    """Returns the bins of a parameter as Python describes it.

    Args:
        key: of the parameter, for errors.
        given: ``(low, high)`` for a continuous range, or :class:`Log`; ``range(a, b)`` for whole
            numbers; a list or an array of choices; or a mapping with the entries of
            :class:`LineSettings`.
        count: of the parts of a range.

    Raises:
        ArgumentError: if it is none of these.
    """
    given = python_values(given)
    with within(key, ValueError, OverflowError, lead=f"{key}={shown(given)}: "):
        if isinstance(given, Mapping):
            return LineSettings(**given).space_bins(count)
        if isinstance(given, range):
            points(sorted({given.start, given.stop}))  # refuses numbers beyond int64
        if isinstance(given, range) and given.step == 1 and len(given) > count:
            edges = torch.linspace(given.start, given.stop, count + 1, dtype=torch.float64)
            low = edges[:-1].ceil().long()
            return Bins(low, torch.cat([low[1:], torch.tensor([given.stop])]) - 1)
        if isinstance(given, Log):
            return intervals(float(given.low), float(given.high), count, log=True)
        if isinstance(given, tuple) and len(given) == 2 and all(map(is_real, given)):
            return intervals(float(given[0]), float(given[1]), count)
        if isinstance(given, list | range) and len(given):
            return choice_bins(list(given))
        raise ValueError("must be (low, high), a range or a list")


def read_part(key: str, given: Any, line: Bins) -> Bins:
    """Returns a part of a parameter's bins, in the dtype of its values.

    Args:
        key: of the part, for errors.
        given: a value, or several that are equally likely; of a range also a part of it, as in
            :func:`read_line`. Or a mapping with the arguments of :func:`weighted_law` or
            :func:`normal_law`.
        line: the parameter's bins.

    Raises:
        ArgumentError: if it is not a part of the line.
    """
    given = python_values(given)
    if isinstance(given, Mapping):
        law = normal_law if "distribution" in given else weighted_law
        with within(key):
            return law(line, **arguments(law, given, ("line",)))
    if isinstance(line, Labelled):
        chosen = given if isinstance(given, list) and given not in line.labels else [given]
        if not chosen or any(one not in line.labels or chosen.count(one) > 1 for one in chosen):
            raise ArgumentError(f"{key}={given!r}: must be among {line.labels}, each once")
        places = torch.tensor(sorted(map(line.labels.index, chosen)))
        return replace(line, low=places, high=places)
    many = [given] if is_real(given) else given
    part = read_line(key, many)
    log, fault = part.log or line.log, ""
    if isinstance(part, Labelled):
        fault = "must be a number, (from, to) or a list of them"
    elif not line.low.is_floating_point() and part.low.is_floating_point():
        fault = "must be whole, as the range is: one, a list or range(from, to + 1)"
    elif log and part.low[0] <= 0:
        fault = "must be above 0 on a logarithmic scale"
    part = Bins(part.low.to(line.low), part.high.to(line.high), log=log)
    if not (fault or line.wide) and (part.wide or not torch.isin(part.low, line.low).all()):
        fault = f"must be among {line.low.tolist()}"
    if fault:
        raise ArgumentError(f"{key}={shown(given)}: {fault}")
    return part


def target_in_file(target: Any, line: Bins) -> Any:
    """Returns a target of a file as in Python: ``[from, to]`` of a range becomes a tuple."""
    return tuple(target) if line.wide and isinstance(target, list) and len(target) == 2 else target


def weighted_law(line: Bins, values: Annotated[list[Any], Len(1)], weights: list[Positive]) -> Law:
    """Returns a distribution over single values with weights.

    Raises:
        ArgumentError: if weights are missing, or a value is not one of the line.
    """
    if len(weights) != len(values):
        raise ArgumentError(f"weights={weights}: must be one for each of {len(values)} values")
    parts = [read_part("values", [one], line).low for one in values]
    if not isinstance(line, Labelled):
        read_part("values", values, line)  # they rise
    single, order = torch.cat(parts).sort()
    summed = torch.tensor(weights, dtype=torch.float64)[order].cumsum(0)
    reached = summed / summed[-1]

    def quantile(shares: Tensor) -> Tensor:
        return single[torch.searchsorted(reached, shares, right=True)]

    def cumulative(ends: Tensor) -> Tensor:
        known = torch.cat([torch.zeros(1, dtype=torch.float64), reached])
        return known[torch.searchsorted(single.double(), ends.double(), right=True)]

    pairs = zip(map(_text, values), map(_text, weights), strict=True)
    name = " or ".join(f"{value} (weight {weight})" for value, weight in pairs)
    return Law(single[:1], single[-1:], quantile, cumulative, name)


def normal_law(
    line: Bins, distribution: Literal["norm"], loc: float = 0.0, scale: Positive = 1.0
) -> Law:
    """Returns a normal distribution on a continuous range, with its tails at the ends.

    Raises:
        ArgumentError: for choices or whole numbers.
    """
    if not line.wide or not line.low.is_floating_point():
        raise ArgumentError(
            f"distribution={distribution}: of a continuous range only; use values and weights"
        )

    def quantile(shares: Tensor) -> Tensor:
        return torch.as_tensor(scipy.special.ndtri(shares.numpy()) * scale + loc)

    def cumulative(ends: Tensor) -> Tensor:
        return torch.as_tensor(scipy.special.ndtr((ends.numpy() - loc) / scale))

    name = f"norm(loc={_text(loc)}, scale={_text(scale)})"
    return Law(line.low[:1], line.high[-1:], quantile, cumulative, name)


def spaces(
    parameters: Mapping[str, RangeSettings], **seeds: Any
) -> tuple[ParameterSpace, ParameterSpace]:
    """Returns the space of some parameters and the distribution of their targets.

    Args:
        parameters: by name.
        seeds: as in :class:`~proposer_rl.tasks.parameters.ParameterSpace`.

    Raises:
        ArgumentError: naming the key, for a name or a value that is not allowed.
    """
    bins, target = {}, {}
    for name, given in parameters.items():
        with within(f"parameters.{name}", ValueError):
            if name in RESERVED or name.startswith("loss_"):
                raise ValueError("is a column of training.csv; choose another name")
            bins[name], target[name] = given.space_bins(), given.target_bins()
        if inside(target[name], bins[name]) < 0.5:  # by mistake, or to extrapolate
            warnings.warn(
                f"parameters.{name}: most of the target, {target[name]}, lies outside of "
                f"low={given.low:g} to high={given.high:g}, from which training levels are drawn",
                stacklevel=2,
            )
    return ParameterSpace(bins, **seeds), ParameterSpace(target, **seeds)


def inside(target: Bins, space: Bins) -> float:
    """Returns the share of a target that lies within the ends of a space."""
    low, high = space.low[:1].double(), space.high[-1:].double()
    below = torch.nextafter(low, low - 1)
    return float(target.below(high) - target.below(below))


def python_values(given: Any) -> Any:
    """Returns a parameter's description in Python's own types; objects among choices stay."""
    if isinstance(given, list | tuple):
        own = [plain(value) if getattr(value, "ndim", None) == 0 else value for value in given]
        return tuple(own) if isinstance(given, tuple) else own
    return given if isinstance(given, range) else plain(given)


def is_real(value: Any) -> bool:
    """Returns whether a value is a number and not a truth value."""
    return isinstance(value, Real) and not isinstance(value, bool)


def value_text(value: Any, digits: int = 6) -> str:
    """Returns a value of a parameter as a text, a number in so many digits."""
    return f"{value:.{digits}g}" if is_real(value) else str(value)


def _text(value: Any) -> str:
    """Returns a value with all of its digits, by which states are compared."""
    return str(value).removesuffix(".0") if is_real(value) else str(value)
