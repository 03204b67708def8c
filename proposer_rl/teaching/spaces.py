"""Spaces of levels for loops of one's own: named ranges, items of a data set, a generator.

They give curricula what a task gives them: levels to draw, bins, and where it is said a target and
small edits. Inside, a level is a tensordict; what a loop gets is :meth:`LevelSpace.given`.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from torch import Tensor

from proposer_rl.models import check_torch_defaults
from proposer_rl.settings import ArgumentError, WholeKeyError, plain, shown, whole
from proposer_rl.task import Distribution, Levels, space_features
from proposer_rl.tasks.parameters import SEED, Bins, Law, ParameterSpace
from proposer_rl.tasks.ranges import (
    inside,
    python_values,
    read_line,
    read_part,
    target_in_file,
)
from proposer_rl.teaching.numbers import as_numbers
from proposer_rl.teaching.tables import (
    expected_log_odds,
    few_columns,
    item_table,
    number_table,
    rate_columns,
)

DRAWN = "level"  # the entry that holds a generator's tensors
Ranges = Mapping[str, Any]
T = TypeVar("T")

Features = Callable[[Any], Any]
"""Gives numbers [n, F] that tell levels [n] apart, each about -1 to 1."""


class LevelSpace:
    """A task of levels alone, as curricula take one.

    Attributes:
        distributions: by name, for hand-designed curricula; ``all`` is the space itself.
    """

    distributions: Mapping[str, Distribution]
    _features: Features | None = None

    @property
    def space(self) -> LevelSpace:
        """Returns what levels are chosen from."""
        return self

    @property
    def target(self) -> Distribution:
        """Returns what is to be mastered.

        Raises:
            ArgumentError: if nothing was said of it.
        """
        if "target" not in self.distributions:
            raise ArgumentError("target: missing: this curriculum needs a target of the space")
        return self.distributions["target"]

    @property
    def description(self) -> dict[str, Any]:
        """Returns what states are compared by: nested dicts of numbers and texts, for JSON."""
        return {"kind": type(self).__qualname__}

    def features(self, levels: Levels) -> Tensor:
        """Returns what a model of outcomes knows of levels: float [*B, F]."""
        if self._features is None:
            return space_features(self, levels)
        shape = levels.shape
        known = number_table(self._features(self.given(levels.reshape(-1))))
        return known.reshape(*shape, known.shape[1])

    def given(self, levels: Levels) -> Any:
        """Returns levels [*B] as a loop gets them."""
        return levels

    def rows(self, levels: Levels) -> list[Any]:
        """Returns levels [n] one by one, for a loop that plays episode by episode."""
        return list(self.given(levels).unbind(0))


class Parameters(LevelSpace, ParameterSpace):
    """Levels that are values of named parameters.

    In batches a level is a tensordict with an entry for each parameter, in torch's default floating
    dtype or int64: of other choices than numbers the place in their list. One by one it is a dict
    of numbers and texts.

    Args:
        ranges: of each parameter, by name: ``(low, high)`` for a continuous range, ``prl.Log(low,
            high)`` for one on a logarithmic scale, ``range(a, b)`` for whole numbers, a list or an
            array for choices among rising numbers, or among texts. Or what task files have:
            ``{"low", "high", "bins", "log", "target"}`` or ``{"values", "target"}``. YAML and JSON
            have no tuples: their ``[5.0, 25.0]`` is two choices, but as the target of such a
            mapping a range.
        bins: equal parts of a range that curricula tell apart; one number for all, or by name. Of
            twenty parameters or more, 1.
        target: what is to be mastered, for some of the parameters, by name: values, or a part of
            the range as in ``ranges``; ``{"values", "weights"}``, or ``{"distribution": "norm",
            "loc", "scale"}``. It goes before the targets in ``ranges``; parameters without one
            have all of theirs. None for no target.
        named: further distributions like ``target``, by name, for hand-designed curricula.
        seeded: whether each level has a ``seed``, a whole number from which its episodes begin.

    Attributes:
        labels: of each parameter, by name: its values, where they are texts; else None.

    Raises:
        ArgumentError: naming the parameter, for what is no range or lies outside of it.

    Example:
        >>> space = Parameters({"gravity": (5.0, 25.0), "ground": ["flat", "stairs"]}, bins=4)
        >>> (level,) = space.rows(space.generate(torch.tensor([[7]]), [torch.Generator()])[0])
        >>> space.size, 20 <= level["gravity"] <= 25, level["ground"]
        (8, True, 'stairs')
    """

    def __init__(
        self,
        ranges: Ranges,
        *,
        bins: int | Mapping[str, int] = 8,
        target: Ranges | None = None,
        named: Mapping[str, Ranges] | None = None,
        seeded: bool = False,
    ) -> None:
        check_torch_defaults()
        if seeded and SEED in ranges:
            raise ArgumentError("ranges.seed, seeded=True: a level has one seed; leave out either")
        named_bins = bins if isinstance(bins, Mapping) else {}
        _check_names("bins", named_bins, ranges)
        counts = dict.fromkeys(ranges, 8 if bins is named_bins else whole("bins", bins, 1))
        counts |= {name: whole(f"bins.{name}", count, 1) for name, count in named_bins.items()}
        ranges = {name: python_values(given) for name, given in ranges.items()}
        in_file = {  # as task files have it, within the range
            name: given.pop("target")
            for name, given in ranges.items()
            if isinstance(given, dict) and "target" in given
        }
        parts = {
            name: read_line(f"ranges.{name}", given, counts[name]) for name, given in ranges.items()
        }
        try:
            super().__init__(parts, seeded)
        except ValueError as error:  # of many parameters
            raise ArgumentError(
                f"bins={bins}: too many combinations of the parameters' bins to be numbered; give "
                "bins=1, which suffices for curricula that need none"
            ) from error
        self.labels = {name: getattr(part, "labels", None) for name, part in parts.items()}
        if in_file:
            _check_names("target", target or {}, parts)
            read = {name: target_in_file(one, parts[name]) for name, one in in_file.items()}
            target = {**read, **(target or {})}
        said = _distributions(target, named)
        self._parts = {name: self._part(name, part) for name, part in said.items()}
        further = {name: ParameterSpace(part, seeded) for name, part in self._parts.items()}
        self.distributions = {"all": self, **further}

    @property
    def target_shares(self) -> Tensor:
        """Returns the shares of the target in each bin, float [N]."""
        target: Any = self.target
        return self.shares(target)

    @property
    def description(self) -> dict[str, Any]:
        """Returns the parameters, their bins, and the target and what else was named."""
        named: dict[str, Any] = {name: self._said(part) for name, part in self._parts.items()}
        target = {"target": named.pop("target")} if "target" in named else {}
        counts = {name: len(part.low) for name, part in self.bins.items() if part.wide}
        return {
            **super().description,
            "ranges": self._said(self.bins),
            "bins": counts,
            "seeded": self._seeded,
            **target,
            "named": named,
        }

    def _said(self, parts: Mapping[str, Bins]) -> dict[str, str]:
        """Returns each parameter's values as a text."""
        found = {}
        for name, part in parts.items():
            ends = part.low[0].item(), part.high[-1].item()
            low, high = (str(end).removesuffix(".0") for end in ends)
            kind = "" if part.low.is_floating_point() else ", whole"
            said = f"{low} to {high}{kind}" if part.wide else str(part.middles)
            log = ", log scale" if part.log else ""
            found[name] = str(part) if isinstance(part, Law) else said + log
        return found

    def given(self, levels: TensorDictBase) -> TensorDictBase:
        """Returns levels as loops get them: real numbers in torch's default dtype."""
        return in_default_dtype(levels)

    def rows(self, levels: TensorDictBase) -> list[dict[str, Any]]:
        """Returns levels [n] as dicts of numbers and texts."""
        columns = {
            str(name): self.bins[name].named(entry) if name in self.bins else entry.tolist()
            for name, entry in levels.items()
        }
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def _part(self, key: str, ranges: Ranges) -> dict[str, Bins]:
        """Returns the bins of a part of the space, by parameter."""
        _check_names(key, ranges, self.bins)
        parts = dict(self.bins)
        for name, given in ranges.items():
            where, line = f"{key}.{name}", self.bins[name]
            parts[name] = part = read_part(where, given, line)
            low, high = line.low[0], line.high[-1]
            if part.low[0] < low or part.high[-1] > high:
                raise ArgumentError(
                    f"{where}={shown(plain(given))}: must lie within {low:g} to {high:g}"
                )
            if isinstance(part, Law) and inside(part, line) < 0.5:
                warnings.warn(
                    f"{where}: most of it, {part}, lies outside of {low:g} to {high:g}, and comes "
                    "from the nearer end",
                    stacklevel=4,
                )
        return parts


class Items(LevelSpace):
    """The items of a data set, such as prompts: a level is the place of one of them, int64.

    Each is a bin of its own.

    Args:
        count: number N of items.
        features: what items are like, such as source, length, difficulty or an embedding: numbers
            [N, D] on any scale as a tensor or an array; or a table, columns by name, or rows, in
            which texts are categories. None for their places alone.
        pass_rates: how often another model, or this one before, solves each, from 0 to 1, [N]; NaN
            where that is not known. A belief begins with them, and outgrows them.
        target: places of those that are to be mastered; None for no target.
        named: further distributions like ``target``, by name.

    Raises:
        ArgumentError: if there is no item, or not a row of features or a pass rate for each.

    Attributes:
        categories: the number of each item's category, int64 [N]; None where no feature is a text.
        pass_rates: float64 [N], or None.
        expected: log odds of success on each by its pass rate, float64 [N]; None without any.

    Example:
        >>> sums = {"source": ["add", "add", "times"], "digits": [1, 6, 2]}
        >>> items = Items(3, features=sums, pass_rates=[0.9, 0.1, float("nan")])
        >>> items.categories, items.inputs(items.generate(torch.tensor([0, 1]), [])).shape
        (tensor([0, 0, 1]), torch.Size([2, 5]))
    """

    def __init__(
        self,
        count: int,
        *,
        features: Any = None,
        pass_rates: Any = None,
        target: Sequence[int] | None = None,
        named: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        check_torch_defaults()
        count = whole("count", count, 1)
        self.size = count
        self.axes = {"item": range(count)}
        lines, self.categories = item_table(
            torch.arange(count).unsqueeze(-1) if features is None else features
        )
        if lines.ndim != 2 or len(lines) != count:
            raise ArgumentError(
                f"features={list(lines.shape)}: must be [{count}, D], a row for each item"
            )
        if len(wrong := (~lines.float().isfinite()).nonzero()):
            number = lines[tuple(wrong[0])]
            what = f"must be finite in float32, as of item {int(wrong[0, 0])}"
            raise ArgumentError(f"features={number:g}: {what}")
        self.pass_rates = self.expected = None
        columns = known = torch.zeros(count, 0)
        if pass_rates is not None:
            rates = as_numbers("pass_rates", pass_rates, (count,), 0, 1, unknown=True)
            self.pass_rates = torch.from_numpy(rates)
            self.expected = expected_log_odds(self.pass_rates)
            columns = rate_columns(self.pass_rates)
        if features is not None:
            known = few_columns(lines, others=columns.shape[1])
        self._inputs = torch.cat([known, columns], 1)
        low, high = lines.amin(0), lines.amax(0)
        self.coordinates = (2 * (lines - low) / (high - low).clamp_min(1e-12) - 1).float()
        self._parts = {
            name: _SomeItems(torch.tensor(_item_places(name, given, count)))
            for name, given in _distributions(target, named).items()
        }
        self.distributions = {"all": self, **self._parts}

    @property
    def target_shares(self) -> Tensor:
        """Returns the shares of the target in each item, float [N]."""
        places: Any = self.target
        return places.places.bincount(minlength=self.size) / len(places.places)

    @property
    def description(self) -> dict[str, Any]:
        """Returns how many there are, a hash of their features, and the places of the target."""
        rates = {} if self.pass_rates is None else {"pass_rates": _hash(self.pass_rates)}
        places = {name: one.places.tolist() for name, one in self._parts.items()}
        return {
            **super().description,
            "count": self.size,
            "features": _hash(self.coordinates),
            **rates,
            **places,
        }

    def locate(self, levels: TensorDictBase) -> Tensor:
        """Returns where items lie, float32 [*B, D]."""
        return self.coordinates[levels["item"]]

    def inputs(self, levels: TensorDictBase) -> Tensor:
        """Returns what a belief knows of items, float32 [*B, D]: ranks, from -1 to 1.

        A belief takes 24. Where there is no room for all features beside the pass rates, they are
        those of the first principal components. A place in a list says nothing, so that D is 0
        without features and pass rates.
        """
        return self._inputs[levels["item"]]

    def items(self, levels: TensorDictBase) -> Tensor:
        """Returns the places of items, int64 [*B], each with a memory of its own."""
        return levels["item"]

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator]) -> TensorDict:
        """Returns the items themselves."""
        return TensorDict({"item": choices}, choices.shape)

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Draws items uniformly."""
        return self.generate(torch.randint(self.size, (count,), generator=generator), [])

    def given(self, levels: TensorDictBase) -> Tensor:
        """Returns places, int64 [*B]."""
        return levels["item"]

    def rows(self, levels: TensorDictBase) -> list[int]:
        """Returns places as Python's numbers."""
        places: list[int] = levels["item"].tolist()
        return places


class _SomeItems:
    def __init__(self, places: Tensor) -> None:
        self.places = places

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        which = torch.randint(len(self.places), (count,), generator=generator)
        return TensorDict({"item": self.places[which]}, [count])


class LevelGenerator(LevelSpace):
    """Levels that a function draws; there are no bins.

    Args:
        draw: ``draw(n, generator)`` gives levels [n]: a tensor, a tensordict, a tensorclass or an
            array, which becomes a tensor. Real numbers become those of torch's default dtype.
        target: the same for what is to be mastered; None for no target.
        edit: ``edit(levels, count, generator)``: levels [n] after so many small random edits; None
            where levels cannot be edited.
        features: ``features(levels)`` gives numbers [n, F] that tell levels [n] apart, each about
            -1 to 1; None for none.
        named: further functions like ``draw``, by name, for hand-designed curricula.

    Raises:
        ArgumentError: if levels are no such thing, or not as many as are asked for.
    """

    def __init__(
        self,
        draw: Callable[[int, torch.Generator], Any],
        *,
        target: Callable[[int, torch.Generator], Any] | None = None,
        edit: Callable[[Any, int, torch.Generator], Any] | None = None,
        features: Features | None = None,
        named: Mapping[str, Callable[[int, torch.Generator], Any]] | None = None,
    ) -> None:
        self._features = features
        drawn = _distributions(target, named)
        parts = {name: _Drawn(name, function) for name, function in drawn.items()}
        self.distributions = {"all": _Drawn("draw", draw), **parts}
        if edit is not None:
            self.edit = self._edits(edit)

    def sample(self, count: int, generator: torch.Generator) -> Levels:
        """Draws levels [count]."""
        return self.distributions["all"].sample(count, generator)

    def inputs(self, levels: Levels) -> Tensor:
        """Returns the features of levels, float [*B, F]; without a function, F is 0."""
        return torch.zeros(*levels.shape, 0) if self._features is None else self.features(levels)

    def given(self, levels: Levels) -> Any:
        """Returns levels as the function gives them."""
        return levels[DRAWN] if DRAWN in levels.keys() else levels

    @property
    def axes(self) -> Any:
        """Refuses, as there are no bins.

        Raises:
            ArgumentError: always.
        """
        raise ArgumentError(
            "space: this curriculum draws from bins, which a generator of levels has not; give "
            "Parameters, Items or a task"
        )

    size = coordinates = generate = target_shares = axes

    def _edits(self, edit: Callable[[Any, int, torch.Generator], Any]) -> Callable[..., Levels]:
        def edited(levels: Levels, count: int, generators: Sequence[torch.Generator]) -> Levels:
            rows = zip(levels, generators, strict=True)
            made = [(edit(self.given(own), count, g), len(own)) for own, g in rows]
            return torch.stack([_taken("edit", new, n) for new, n in made])

        return edited


class _Drawn:
    """Draws levels by a function."""

    def __init__(self, name: str, draw: Callable[[int, torch.Generator], Any]) -> None:
        self._name, self._draw = name, draw

    def sample(self, count: int, generator: torch.Generator) -> Levels:
        return _taken(self._name, self._draw(count, generator), count)


def _taken(name: str, levels: Any, count: int) -> Levels:
    """Returns levels [count] that a function gives, as curricula take them."""
    if isinstance(levels, np.ndarray):
        levels = torch.from_numpy(levels.copy())
    collection = is_tensor_collection(levels)
    if not (collection or isinstance(levels, Tensor)) or tuple(levels.shape[:1]) != (count,):
        found = list(getattr(levels, "shape", ())) or type(levels).__name__
        raise WholeKeyError(f"{name}={found}: must give a tensor or tensordict of {count} levels")
    levels = in_default_dtype(levels)
    return levels if collection else TensorDict({DRAWN: levels}, [count])


def in_default_dtype(levels: Any) -> Any:
    """Returns levels with their real numbers in torch's default dtype, as networks have theirs."""
    real = torch.get_default_dtype()
    if isinstance(levels, Tensor):
        return levels.to(real) if levels.is_floating_point() else levels
    return levels.apply(in_default_dtype)


def _hash(numbers: Tensor) -> str:
    return hashlib.sha256(numbers.contiguous().numpy().tobytes()).hexdigest()[:16]


def _item_places(name: str, given: Any, count: int) -> list[int]:
    """Returns places of items, also of a single one, as a list."""
    places = plain(given)
    places = [*places] if isinstance(places, Iterable) else [places]
    if not places or not all(type(one) is int and 0 <= one < count for one in places):
        raise ArgumentError(f"{name}={shown(places)}: must be places from 0 to {count - 1}")
    return places


def _distributions(target: T | None, named: Mapping[str, T] | None) -> dict[str, T]:
    """Returns what is said of distributions beside the space itself, by their names."""
    for name in named or {}:
        if name == "all" or (name == "target" and target is not None):
            raise ArgumentError(f"named.{name}: must have another name, which none has yet")
    return {**({} if target is None else {"target": target}), **(named or {})}


def _check_names(key: str, given: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ArgumentError(f"{key}.{unknown[0]}: unknown; there are: {', '.join(known)}")
