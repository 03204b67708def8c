"""Spaces of levels for loops of one's own: named ranges, items of a data set, a generator.

They give curricula what a task gives them: levels to draw, bins, and where it is said a target and
small edits. Inside, a level is a tensordict; what a loop gets is :meth:`LevelSpace.given`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from operator import index
from typing import Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.models import callers_state, own_state
from proposer_rl.settings import ArgumentError
from proposer_rl.task import Distribution, Levels, space_features
from proposer_rl.tasks.parameters import SEED, Bins, ParameterSpace, intervals, points

DRAWN = "level"  # the entry that holds a generator's tensors
Ranges = Mapping[str, Any]
T = TypeVar("T")


class LevelSpace:
    """What curricula take for a task: here one that has levels alone.

    Attributes:
        distributions: by name, for hand-designed curricula; ``all`` is the space itself.
    """

    distributions: Mapping[str, Distribution]

    @property
    def space(self) -> LevelSpace:
        """What levels are chosen from."""
        return self

    @property
    def target(self) -> Distribution:
        """What is to be mastered.

        Raises:
            ArgumentError: if nothing was said of it.
        """
        if "target" not in self.distributions:
            raise ArgumentError("target: missing: this curriculum needs a target of the space")
        return self.distributions["target"]

    def features(self, levels: Levels) -> Tensor:
        """What a model of outcomes knows of levels: float [*B, F]."""
        return space_features(self, levels)

    def given(self, levels: Levels) -> Any:
        """Levels [*B] as a loop gets them."""
        return levels

    def rows(self, levels: Levels) -> list[Any]:
        """Levels [n] one by one, as a loop gets them that plays episode by episode."""
        return list(self.given(levels).unbind(0))


class Parameters(LevelSpace, ParameterSpace):
    """Levels that are values of named parameters.

    In batches a level is a tensordict with an entry for each parameter, float64 or int64, of texts
    the place in their list. One by one it is a dict of numbers and texts.

    Args:
        ranges: of each parameter, by name: ``(low, high)`` for a continuous range, ``range(a, b)``
            for whole numbers, a list for choices among rising numbers, or among texts.
        bins: equal parts of a range that curricula tell apart; one number for all, or by name. Of
            twenty parameters or more, 1.
        target: what is to be mastered, for some of the parameters, by name: a value or a part of
            the range, as in ``ranges``; the others have all of theirs. None for no target.
        named: further distributions like ``target``, by name, for hand-designed curricula.
        seeded: whether each level has a ``seed``, a whole number from which its episodes begin.

    Raises:
        ArgumentError: naming the parameter, for what is no range or lies outside of it.

    Example:
        >>> space = Parameters({"gravity": (5.0, 25.0), "ground": ["flat", "stairs"]}, bins=4)
        >>> (level,) = space.rows(space.generate(torch.tensor([[7]]), [torch.Generator()])[0])
        >>> space.size, 20 <= level["gravity"] <= 25, level["ground"]
        (8, True, 'stairs')
    """

    @own_state()
    def __init__(
        self,
        ranges: Ranges,
        *,
        bins: int | Mapping[str, int] = 8,
        target: Ranges | None = None,
        named: Mapping[str, Ranges] | None = None,
        seeded: bool = False,
    ) -> None:
        if not ranges:
            raise ArgumentError("ranges={}: must have at least one parameter")
        if seeded and SEED in ranges:
            raise ArgumentError("ranges.seed, seeded=True: a level has one seed; leave out either")
        counts = dict(bins) if isinstance(bins, Mapping) else dict.fromkeys(ranges, bins)
        _check_names("bins", counts, ranges)
        self._labels = {name: _labels(values) for name, values in ranges.items()}
        parts = {
            name: _bins(f"ranges.{name}", values, counts.get(name, 8), self._labels[name])
            for name, values in ranges.items()
        }
        try:
            super().__init__(parts, seeded)
        except ValueError as error:  # of many parameters
            raise ArgumentError(
                f"bins={bins}: too many combinations of the parameters' bins to be numbered; give "
                "bins=1, which suffices for curricula that need none"
            ) from error
        further = {
            name: ParameterSpace(self._part(name, part), seeded)
            for name, part in _distributions(target, named).items()
        }
        self.distributions = {"all": self, **further}

    @property
    def target_shares(self) -> Tensor:
        """The target as shares of the bins, float [N]."""
        target: Any = self.target
        return self.shares(target)

    def rows(self, levels: TensorDictBase) -> list[dict[str, Any]]:
        """Levels [n] as dicts of numbers and texts."""
        columns = {str(name): entry.tolist() for name, entry in levels.items()}
        for name, labels in self._labels.items():
            if labels is not None:
                columns[name] = [labels[place] for place in columns[name]]
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def _part(self, key: str, ranges: Ranges) -> dict[str, Bins]:
        """The bins of a part of the space: one for each parameter or value."""
        _check_names(key, ranges, self.bins)
        parts = dict(self.bins)
        for name, values in ranges.items():
            whole, labels = self.bins[name], self._labels[name]
            where = f"{key}.{name}"
            if labels is not None:
                chosen = values if isinstance(values, list) else [values]
                if any(value not in labels or chosen.count(value) > 1 for value in chosen):
                    raise ArgumentError(f"{where}={values!r}: must be among {labels}, each once")
                parts[name] = points(sorted(labels.index(value) for value in chosen))
                continue
            values = [values] if isinstance(values, Real) else values
            part = _bins(where, values, 1, None)
            low, high = whole.low[0], whole.high[-1]
            if part.low[0] < low or part.high[-1] > high:
                raise ArgumentError(f"{where}={values}: must lie within {low:g} to {high:g}")
            if not whole.low.is_floating_point() and part.low.is_floating_point():
                raise ArgumentError(f"{where}={values}: must be whole, as the range is")
            parts[name] = Bins(part.low.to(whole.low), part.high.to(whole.high))
        return parts


class _Texts(Bins):
    """The places of texts in their list, which has no order."""

    def moved(self, old: Tensor, noise: Tensor) -> Tensor:
        """Another place, so many further on."""
        count = len(self.low)
        further = 1 + (noise.abs() * 1e6).long() % max(count - 1, 1)
        return (old + further) % count


class Items(LevelSpace):
    """The items of a data set, such as prompts: a level is the place of one of them, int64.

    Each is a bin of its own.

    Args:
        count: number N of items.
        features: numbers that tell what items are like, float [N, D]; None for their places alone.
        target: places of those that are to be mastered; None for no target.
        named: further distributions like ``target``, by name.

    Raises:
        ArgumentError: if there is no item, or not a row of features for each.
    """

    @own_state()
    def __init__(
        self,
        count: int,
        *,
        features: Tensor | None = None,
        target: Sequence[int] | None = None,
        named: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        if count < 1:
            raise ArgumentError(f"count={count}: must be at least 1")
        self.size = count
        self.axes = {"item": range(count)}
        lines = torch.arange(count).unsqueeze(-1) if features is None else torch.as_tensor(features)
        if lines.ndim != 2 or len(lines) != count or not lines.isfinite().all():
            raise ArgumentError(
                f"features={list(lines.shape)}: must have a row of finite numbers for each item"
            )
        low, high = lines.amin(0), lines.amax(0)
        self.coordinates = (2 * (lines - low) / (high - low).clamp_min(1e-12) - 1).float()
        parts = {}
        for name, given in _distributions(target, named).items():
            places = [*map(index, given)]  # also of a tensor
            if not places or min(places) < 0 or max(places) >= count:
                raise ArgumentError(f"{name}={places}: must be places from 0 to {count - 1}")
            parts[name] = _SomeItems(torch.tensor(places))
        self.distributions = {"all": self, **parts}

    @property
    def target_shares(self) -> Tensor:
        """The target as shares of the items, float [N]."""
        places: Any = self.target
        return places.places.bincount(minlength=self.size) / len(places.places)

    def locate(self, levels: TensorDictBase) -> Tensor:
        """Where items lie, float32 [*B, D]."""
        return self.coordinates[levels["item"]]

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator]) -> TensorDict:
        """The items themselves."""
        return TensorDict({"item": choices}, choices.shape)

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """Items drawn uniformly."""
        return self.generate(torch.randint(self.size, (count,), generator=generator), [])

    def given(self, levels: TensorDictBase) -> Tensor:
        """Places, int64 [*B]."""
        return levels["item"]

    def rows(self, levels: TensorDictBase) -> list[int]:
        """Places as Python's numbers."""
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
        draw: ``draw(n, generator)`` gives levels [n]: a tensor, a tensordict or a tensorclass.
        target: the same for what is to be mastered; None for no target.
        edit: ``edit(levels, count, generator)``: levels [n] after so many small random edits; None
            where levels cannot be edited.
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
        named: Mapping[str, Callable[[int, torch.Generator], Any]] | None = None,
    ) -> None:
        drawn = _distributions(target, named)
        parts = {name: _Drawn(name, function) for name, function in drawn.items()}
        self.distributions = {"all": _Drawn("draw", draw), **parts}
        if edit is not None:
            self.edit = self._edits(edit)

    def sample(self, count: int, generator: torch.Generator) -> Levels:
        """Levels [count]."""
        return self.distributions["all"].sample(count, generator)

    def given(self, levels: Levels) -> Any:
        """Levels as the function gives them."""
        return levels[DRAWN] if DRAWN in levels.keys() else levels

    @property
    def axes(self) -> Any:
        """There are none.

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
            with callers_state():
                made = [edit(self.given(own), count, generator) for own, generator in rows]
            return torch.stack([_wrapped(one) for one in made])

        return edited


class _Drawn:
    def __init__(self, name: str, draw: Callable[[int, torch.Generator], Any]) -> None:
        self._name, self._draw = name, draw

    def sample(self, count: int, generator: torch.Generator) -> Levels:
        with callers_state():
            levels = self._draw(count, generator)
        if not hasattr(levels, "shape") or tuple(levels.shape[:1]) != (count,):
            shape = list(getattr(levels, "shape", ())) or type(levels).__name__
            raise ArgumentError(f"{self._name}={shape}: must give {count} levels, [{count}, ...]")
        return _wrapped(levels)


def _wrapped(levels: Any) -> Levels:
    return TensorDict({DRAWN: levels}, levels.shape[:1]) if isinstance(levels, Tensor) else levels


def _distributions(target: T | None, named: Mapping[str, T] | None) -> dict[str, T]:
    """What is said of distributions beside the space itself, by their names."""
    return {**({} if target is None else {"target": target}), **(named or {})}


def _labels(values: Any) -> list[Any] | None:
    """The values of a list some of which are not numbers; None for any other."""
    if isinstance(values, list) and any(not _is_number(value) for value in values):
        return values
    return None


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def _bins(key: str, values: Any, count: int, labels: list[Any] | None) -> Bins:
    """The bins of a range."""
    if not isinstance(count, int) or count < 1:
        raise ArgumentError(f"bins={count}: must be at least 1")
    if labels is not None:
        places = torch.arange(len(labels))
        return _Texts(places, places)
    try:
        if isinstance(values, range) and values.step == 1 and len(values) > count:
            edges = torch.linspace(values.start, values.stop, count + 1, dtype=torch.float64)
            low = edges[:-1].ceil().long()
            return Bins(low, torch.cat([low[1:], torch.tensor([values.stop])]) - 1)
        if isinstance(values, tuple) and len(values) == 2 and all(map(_is_number, values)):
            return intervals(float(values[0]), float(values[1]), count)
        if isinstance(values, list | range) and len(values):
            return points(list(values))
    except ValueError as error:
        raise ArgumentError(f"{key}={values!r}: {error}") from error
    raise ArgumentError(f"{key}={values!r}: must be (low, high), a range or a list")


def _check_names(key: str, given: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ArgumentError(f"{key}.{unknown[0]}: unknown; there are: {', '.join(known)}")
