"""Spaces of levels for your own training loop: named ranges, items of a data set, a generator.

A space offers curricula what a task does: levels to draw, and depending on the space bins, a target
and small edits. Curricula see levels as tensordicts; :meth:`LevelSpace.given` converts them for the
loop.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from torch import Tensor

from proposer_rl.models import check_torch_defaults
from proposer_rl.settings import ArgumentError, plain, refuse_unknown, shown, whole, within
from proposer_rl.task import Distribution, Levels, space_features
from proposer_rl.tasks.parameters import Bins, Law, ParameterSpace
from proposer_rl.tasks.ranges import (
    inside,
    python_values,
    read_line,
    read_part,
    target_in_file,
)
from proposer_rl.teaching.numbers import as_ids, as_numbers
from proposer_rl.teaching.tables import (
    expected_log_odds,
    few_columns,
    item_table,
    number_table,
    rate_columns,
)

DRAWN = "level"  # the entry of levels that are plain tensors
Ranges = Mapping[str, Any]
T = TypeVar("T")

Make = Callable[[TensorDictBase, torch.Generator], Any]
Features = Callable[[Any], Any]
"""Returns numbers [n, F] that describe levels [n], each about -1 to 1."""


class LevelSpace:
    """The base of spaces: a task for curricula that consists of levels only.

    Attributes:
        distributions: distributions of levels by name; ``all`` is the space itself.
    """

    distributions: Mapping[str, Distribution]
    _features: Features | None = None

    @property
    def space(self) -> LevelSpace:
        """Returns the space, as tasks do."""
        return self

    @property
    def target(self) -> Distribution:
        """Returns the distribution of levels that is to be mastered.

        Raises:
            ArgumentError: if no target was given.
        """
        if "target" not in self.distributions:
            raise ArgumentError("target: missing: this curriculum needs a space with a target")
        return self.distributions["target"]

    def features(self, levels: Levels) -> Tensor:
        """Returns features of levels, by which models of outcomes predict: float [*B, F]."""
        if self._features is None:
            return space_features(self, levels)
        shape = levels.shape
        known = number_table(self._features(self.given(levels.reshape(-1))))
        return known.reshape(*shape, known.shape[1])

    def given(self, levels: Levels) -> Any:
        """Returns levels [*B] as the loop gets them: real numbers in torch's default dtype."""
        return in_default_dtype(levels)

    def rows(self, levels: Levels) -> list[Any]:
        """Returns levels [n] as a list, for loops that play episode by episode."""
        return list(self.given(levels).unbind(0))


class Parameters(LevelSpace, ParameterSpace):
    """Levels that are values of named parameters.

    A batch of levels is a tensordict with an entry for each parameter: torch's default floating
    dtype for real numbers, int64 for whole ones; choices that are not numbers are their places in
    the list. A single level is a dict of numbers and texts.

    Args:
        ranges: the values of each parameter, by name: ``(low, high)`` for a continuous range,
            ``prl.Log(low, high)`` for one on a logarithmic scale, ``range(a, b)`` for whole
            numbers, a list or an array for choices among rising numbers or among texts. Or as in
            task files: ``{"low", "high", "bins", "log", "target"}`` or ``{"values", "target"}``.
            Note that a list ``[5.0, 25.0]``, as YAML and JSON have it, means two choices, and only
            as the target of such a mapping a range.
        bins: number of equal parts of each range that curricula tell apart, for all parameters or
            by name. Give 1 for twenty parameters or more.
        target: the levels that are to be mastered, for some of the parameters by name: a value or
            several, a part of the range as in ``ranges``, ``{"values", "weights"}``, or
            ``{"distribution": "norm", "loc", "scale"}``. It overrides targets in ``ranges``; other
            parameters keep their whole range. None for no target.
        named: further distributions like ``target``, by name, for hand-designed curricula.
        seeded: whether each level has a ``seed``, a whole number to reset its episodes with.

    Raises:
        ArgumentError: naming the parameter, for something that is no range or not within it.
        ValueError: if the combinations of the parameters' bins are too many to be numbered.

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
        named_bins = bins if isinstance(bins, Mapping) else {}
        with within("bins"):
            refuse_unknown(named_bins, ranges)
        counts = dict.fromkeys(ranges, 8 if bins is named_bins else whole("bins", bins, 1))
        counts |= {name: whole(f"bins.{name}", count, 1) for name, count in named_bins.items()}
        ranges = {name: python_values(given) for name, given in ranges.items()}
        in_file = {  # targets given as in task files
            name: given.pop("target")
            for name, given in ranges.items()
            if isinstance(given, dict) and "target" in given
        }
        parts = {
            name: read_line(f"ranges.{name}", given, counts[name]) for name, given in ranges.items()
        }
        super().__init__(parts, seeded)
        if in_file:
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
        """Describes the parameters, target and named distributions, to compare states by."""
        described = {"ranges": self.bins, **self._parts}
        return {"seeded": self._seeded} | {
            of: {
                name: [part.low[0].item(), part.high[-1].item(), len(part.low), str(part)]
                for name, part in parts.items()
            }
            for of, parts in described.items()
        }

    def rows(self, levels: TensorDictBase) -> list[dict[str, Any]]:
        """Returns levels [n] as dicts of numbers and texts."""
        columns = {
            str(name): self.bins[name].named(entry) if name in self.bins else entry.tolist()
            for name, entry in levels.items()
        }
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def _part(self, key: str, ranges: Ranges) -> dict[str, Bins]:
        """Returns the bins of a part of the space, by parameter."""
        with within(key):
            refuse_unknown(ranges, self.bins)
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
                    f"{where}: most of {part} lies outside of {low:g} to {high:g}, so that most "
                    "draws are at its nearer end",
                    stacklevel=4,
                )
        return parts


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

    rows = LevelSpace.rows

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


class Items(LevelSpace):
    """Levels that are the items of a data set, such as prompts: the place of each, int64.

    Every item is a bin.

    Args:
        count: number N of items.
        features: a description of the items, such as source, length, difficulty or an embedding:
            numbers [N, D] on any scale as a tensor or an array; or a table, columns by name, or
            rows, in which texts are categories. None if there is none.
        pass_rates: the share of attempts at each item that another or an earlier model solved, from
            0 to 1, [N]; NaN where it is unknown. Curricula with a belief start from them.
        target: places of the items that are to be mastered; None for no target.
        named: further distributions like ``target``, by name.

    Raises:
        ArgumentError: if there is no item, or not one row of features or pass rate for each.

    Attributes:
        categories: the number of each item's category, int64 [N]; None if no feature is a text.
        pass_rates: float64 [N], or None.
        expected: log odds of success on each item by its pass rate, float64 [N], or None.

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
        self.size = count = whole("count", count, 1)
        self.axes = {"item": range(count)}
        lines, self.categories = item_table(
            torch.arange(count).unsqueeze(-1) if features is None else features
        )
        as_numbers("features", lines, (count, None))
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
        self._places = {
            name: torch.from_numpy(as_ids(name, given, count))
            for name, given in _distributions(target, named).items()
        }
        parts = {name: _Drawn(partial(_among, one)) for name, one in self._places.items()}
        self.distributions = {"all": self, **parts}

    @property
    def target_shares(self) -> Tensor:
        """Returns the shares of the target in each item, float [N]."""
        self.target  # noqa: B018  which must be there
        places = self._places["target"]
        return places.bincount(minlength=self.size) / len(places)

    @property
    def description(self) -> dict[str, Any]:
        """Describes the items, to compare states by: number, hash of features, target's places."""
        rates = {} if self.pass_rates is None else {"pass_rates": _hash(self.pass_rates)}
        places = {name: one.tolist() for name, one in self._places.items()}
        return {
            "count": self.size,
            "features": _hash(self.coordinates),
            **rates,
            **places,
        }

    def locate(self, levels: TensorDictBase) -> Tensor:
        """Returns coordinates of items, each from -1 to 1: float32 [*B, D]."""
        return self.coordinates[levels["item"]]

    def inputs(self, levels: TensorDictBase) -> Tensor:
        """Returns the inputs of a belief for items: ranks from -1 to 1, float32 [*B, D].

        D is at most 24: if there are too many features beside the pass rates, the ranks are those
        of the first principal components. Without features and pass rates D is 0.
        """
        return self._inputs[levels["item"]]

    def items(self, levels: TensorDictBase) -> Tensor:
        """Returns the places of items, int64 [*B], by which beliefs remember each of them."""
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
        return [*levels["item"].tolist()]


def _among(places: Tensor, count: int, generator: torch.Generator) -> TensorDict:
    """Draws some of the items at places."""
    which = torch.randint(len(places), (count,), generator=generator)
    return TensorDict({"item": places[which]}, [count])


class LevelGenerator(LevelSpace):
    """Levels that a function draws, without bins.

    Args:
        draw: ``draw(n, generator)`` gives levels [n]: a tensor, a tensordict, a tensorclass or an
            array, which becomes a tensor. Real numbers become those of torch's default dtype.
        target: a function like ``draw`` for the levels that are to be mastered; None for no target.
        edit: ``edit(levels, count, generator)`` returns levels [n] after ``count`` small random
            edits; None if levels cannot be edited.
        features: ``features(levels)`` returns numbers [n, F] that describe levels [n], each about
            -1 to 1; None for none.
        named: further functions like ``draw``, by name, for hand-designed curricula.
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
        functions = {"all": draw, **_distributions(target, named)}
        self.distributions = {name: _Drawn(function) for name, function in functions.items()}
        if edit is not None:
            self.edit = partial(self._edited, edit)

    def sample(self, count: int, generator: torch.Generator) -> Levels:
        """Draws levels [count]."""
        return self.distributions["all"].sample(count, generator)

    def inputs(self, levels: Levels) -> Tensor:
        """Returns the features of levels, float [*B, F]; F is 0 without a function."""
        return torch.zeros(*levels.shape, 0) if self._features is None else self.features(levels)

    def given(self, levels: Levels) -> Any:
        """Returns levels as the function draws them."""
        return levels[DRAWN] if DRAWN in levels.keys() else levels

    @property
    def axes(self) -> Any:
        """Raises an ArgumentError, as there are no bins."""
        raise ArgumentError(
            "space: this curriculum draws from bins, which a generator of levels does not have; "
            "give Parameters, Items or a task"
        )

    size = coordinates = generate = target_shares = axes

    def _edited(
        self, edit: Any, levels: Levels, count: int, generators: Sequence[torch.Generator]
    ) -> Levels:
        rows = zip(levels, generators, strict=True)
        return torch.stack([_taken(edit(self.given(own), count, g), len(own)) for own, g in rows])


class _Drawn:
    """Draws levels by a function."""

    def __init__(self, draw: Callable[[int, torch.Generator], Any]) -> None:
        self._draw = draw

    def sample(self, count: int, generator: torch.Generator) -> Levels:
        return _taken(self._draw(count, generator), count)


def _taken(levels: Any, count: int) -> Levels:
    """Returns levels [count] of a user's function as a tensordict."""
    if is_tensor_collection(levels):
        return in_default_dtype(levels)
    if not isinstance(levels, Tensor):
        levels = torch.from_numpy(np.array(levels))  # a copy, as it may have negative strides
    return TensorDict({DRAWN: in_default_dtype(levels)}, [count])


def in_default_dtype(levels: Any) -> Any:
    """Returns levels with their real numbers in torch's default dtype, as networks have theirs."""
    real = torch.get_default_dtype()
    if isinstance(levels, Tensor):
        return levels.to(real) if levels.is_floating_point() else levels
    return levels.apply(in_default_dtype)


def _hash(numbers: Tensor) -> str:
    return hashlib.sha256(numbers.contiguous().numpy().tobytes()).hexdigest()[:16]


def _distributions(target: T | None, named: Mapping[str, T] | None) -> dict[str, T]:
    """Returns the distributions beside the space itself, by name."""
    return {**({} if target is None else {"target": target}), **(named or {})}
