"""Spaces as Solvers' networks take them: numbers, images, and actions in one tensor."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor
from torchrl.data import Categorical, MultiCategorical, TensorSpec, Unbounded

from proposer_rl.settings import shown
from proposer_rl.tasks.gymnasium.environment import UnfitEnvironmentError

# Spaces whose values are one number or an array of them.
NUMERIC = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
UNBOUNDED = 1e9  # what a bound of at least this means; no number in use comes near
IMAGE_SIDE = 16  # pixels at least, of a map of bytes without channels
NUMBERS_ENTRY = "observation"  # the entry of all numbers, or of the only image


class Layout:
    """Turns what environments show into tensors, and a Solver's actions into what they take.

    Observations become numbers [D], where whole numbers to choose from are one-hot, or an image of
    three axes. Where both are seen, or several images, there are several entries: the numbers by
    the name of ``observation``, each image by its own after ``image``.

    Actions become one of n, one of several n each, or numbers [D] whose bounded parts go from -1 to
    1; what is beyond a bound is clipped.

    Args:
        observation_space, action_space: of one environment.

    Attributes:
        seen: specs of the entries by name, without a batch.
        acts: spec of the actions.

    Raises:
        UnfitEnvironmentError: for spaces that no network is for, saying what there is one for.
    """

    def __init__(
        self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self._parts: dict[str, Any] = {}  # in the order of the space
        for name, part in leaves(observation_space):
            while name in self._parts:  # a.b is a name with a dot, or b in a
                name += "'"
            self._parts[name] = part
        for name, part in self._parts.items():
            if not isinstance(part, NUMERIC):
                way = "; a wrapper can make numbers of it"
                if name:
                    way = (
                        f", its part {name}; a wrapper can leave it out, as wrappers="
                        "[{gymnasium.wrappers.FilterObservation: {filter_keys: [...]}}] does"
                    )
                raise UnfitEnvironmentError(
                    f"observation space {observation_space}: there is no network for {part}{way}"
                )
        nothing = [torch.from_numpy(np.zeros(p.shape, p.dtype)) for p in self._parts.values()]
        self.seen = {
            name: Unbounded(entry.shape, dtype=entry.dtype)
            for name, entry in self.entries(nothing).items()
        }
        self._taken = [PartTaken(part) for _, part in leaves(action_space)]
        self.acts = self._acts()

    def entries(self, shown: Iterable[Tensor]) -> dict[str, Tensor]:
        """Returns what a Solver sees: float32, or uint8 of bytes, [*B, ...] by name.

        Args:
            shown: parts of observations [*B, ...], in the order of those of their space.
        """
        named = sorted(zip(self._parts.items(), shown, strict=True), key=lambda one: one[0][0])
        found, rows = {}, []
        for (name, part), seen in named:
            if is_image(part):
                found[f"image {name}"] = _of_three_axes(seen, part)
            else:
                rows.append(_row(seen, part))
        if rows:
            bytes_ = all(row.dtype == torch.uint8 for row in rows)
            found[NUMBERS_ENTRY] = torch.cat(rows if bytes_ else [row.float() for row in rows], -1)
        found = {
            k: seen if seen.dtype == torch.uint8 else seen.float() for k, seen in found.items()
        }
        return found if len(found) > 1 else {NUMBERS_ENTRY: next(iter(found.values()))}

    def own_actions(self, actions: Tensor) -> list[Tensor]:
        """Returns the parts of the space's actions, [*B, ...] each, from a Solver's."""
        rows = actions.unsqueeze(-1) if isinstance(self.action_space, spaces.Discrete) else actions
        parts = rows.split([taken.size for taken in self._taken], -1)
        return [taken(row) for taken, row in zip(self._taken, parts, strict=True)]

    def taken(self, actions: Tensor) -> Any:
        """Returns a Solver's actions [*B, ...] as arrays in the structure of the action space."""
        own = (part.numpy() for part in self.own_actions(actions.cpu()))
        return assembled(self.action_space, own)

    def _acts(self) -> TensorSpec:
        space, parts = self.action_space, [taken.part for taken in self._taken]
        if isinstance(space, spaces.Discrete):
            return Categorical(int(space.n))
        if all(isinstance(part, spaces.Box) and part.dtype.kind == "f" for part in parts):
            return Unbounded(sum(taken.size for taken in self._taken))
        if all(isinstance(part, NUMERIC) and not isinstance(part, spaces.Box) for part in parts):
            counts = torch.tensor([count for part in parts for count in _options(part)])
            return MultiCategorical(counts, shape=counts.shape)  # also of a single choice
        raise UnfitEnvironmentError(
            f"action space {space}: there is a policy for a Discrete, a MultiDiscrete or a "
            "MultiBinary one, for a Box of floats, and for dictionaries and tuples of either; a "
            "wrapper can make it one"
        )


class PartTaken:
    """Makes actions of a part of an action space from numbers of -1 to 1, or choices from 0 on.

    Attributes:
        part: the space.
        size: how many numbers or choices there are.
    """

    def __init__(self, part: Any) -> None:
        self.part, self.size = part, math.prod(part.shape or ())
        self._dtype = torch.from_numpy(np.empty(0, part.dtype)).dtype
        if isinstance(part, spaces.Box):  # middle + reach * number, within low and high
            low, high = (
                torch.from_numpy(x.astype(np.float64).ravel()) for x in (part.low, part.high)
            )
            bounded = (low > -UNBOUNDED) & (high < UNBOUNDED)
            first, last = low.where(bounded, -1.0), high.where(bounded, 1.0)
            self._scale = (first + last) / 2, (last - first) / 2, low, high

    def __call__(self, row: Tensor) -> Tensor:
        """Returns actions [*B, ...] of the part, from rows [*B, D]."""
        if isinstance(self.part, spaces.Box):
            middle, reach, low, high = (end.to(row.device) for end in self._scale)
            row = (middle + reach * row).clamp(low, high)
        own = row.reshape((*row.shape[:-1], *self.part.shape))
        if not isinstance(self.part, spaces.Box):
            own = own + torch.as_tensor(getattr(self.part, "start", 0), device=row.device)
        return own.to(self._dtype)


def typed(space: Any, seen: Any) -> Any:
    """Returns an observation whose numbers have the types of its space, in its order.

    Raises:
        UnfitEnvironmentError: where a part has another shape, or would become another number. A
            float beyond its bounds does not: nothing here depends on them.
    """
    if isinstance(space, spaces.Dict):
        return {name: typed(part, seen[name]) for name, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(typed(part, one) for part, one in zip(space.spaces, seen, strict=True))
    if not isinstance(space, NUMERIC):
        return seen
    array = np.asarray(seen)
    fits = array.shape == space.shape and array.dtype.kind in "biuf"
    # Floats of a box are not looked at one by one: that would take longer than many a step.
    floats = array.dtype.kind == "f" == space.dtype.kind
    if fits and not (isinstance(space, spaces.Box) and (floats or array.dtype == space.dtype)):
        with np.errstate(invalid="ignore"):
            fits = np.array_equal(array.astype(space.dtype), array)
        fits = fits and (isinstance(space, spaces.Box) or space.contains(array.astype(space.dtype)))
    if not fits:
        raise UnfitEnvironmentError(
            f"the environment shows {shown(seen)}, {array.dtype} {list(array.shape)}; its "
            f"observation space is {space}"
        )
    return array.astype(space.dtype, copy=False)


def is_image(space: spaces.Space[Any]) -> bool:
    """Returns whether a space is of images: three axes or four, or two of bytes and not short."""
    if not isinstance(space, spaces.Box):
        return False
    bytes_ = space.dtype == np.uint8 and min(space.shape, default=0) >= IMAGE_SIDE
    return len(space.shape) in (3, 4) or (len(space.shape) == 2 and bytes_)


def channels_first(shape: tuple[int, ...]) -> bool:
    """Returns whether the channels of an image are its first axis, or else its last.

    They are the axis that differs where the other two are alike, or else the shortest.

    Raises:
        ValueError: where the shape does not tell.

    Example:
        >>> channels_first((4, 84, 84)), channels_first((7, 7, 20)), channels_first((20, 24, 3))
        (True, False, False)
    """
    first, middle, last = shape
    if (first == middle) != (middle == last):
        return middle == last
    if first != last and min(first, last) < middle:
        return first < last
    raise ValueError(
        f"images {list(shape)}: which axis are the channels? Say network.image=HWC or CHW"
    )


def _row(seen: Tensor, space: Any) -> Tensor:
    """Returns numbers [*B, ...] of a space in a row [*B, D], choices one-hot."""
    row = seen.reshape(*seen.shape[: seen.ndim - len(space.shape)], -1)
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        return row
    choices = zip(row.unbind(-1), np.ravel(space.start).tolist(), _options(space), strict=True)
    hot = [x[..., None] == torch.arange(s, s + n, device=x.device) for x, s, n in choices]
    return torch.cat(hot, -1)


def _options(space: Any) -> list[int]:
    """Returns how many options each choice has."""
    if isinstance(space, spaces.MultiBinary):
        return [2] * math.prod(space.shape)
    counts: list[int] = np.ravel(getattr(space, "nvec", getattr(space, "n", 0))).tolist()
    return counts


def _of_three_axes(image: Tensor, box: spaces.Box) -> Tensor:
    """Returns images [*B, ...] with one axis of channels."""
    if len(box.shape) == 2:
        return image.unsqueeze(-1)
    if len(box.shape) == 3:
        return image
    if channels_first(box.shape[1:]):
        return image.flatten(-4, -3)
    return image.movedim(-4, -2).flatten(-2)


def leaves(whole: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yields parts of a space or an observation below dictionaries and tuples, by dotted names."""
    if isinstance(whole, Mapping | tuple | spaces.Tuple):  # a space of dictionaries is a Mapping
        for part, inner in whole.items() if isinstance(whole, Mapping) else enumerate(whole):
            yield from leaves(inner, f"{name}.{part}" if name else str(part))
    else:
        yield name, whole


def in_order(space: spaces.Space[Any], seen: Any) -> Iterator[Any]:
    """Yields the parts of an observation, in the order of those of its space."""
    if isinstance(space, spaces.Dict):
        for name, inner in space.spaces.items():
            yield from in_order(inner, seen[name])
    elif isinstance(space, spaces.Tuple):
        for inner, one in zip(space.spaces, seen, strict=True):
            yield from in_order(inner, one)
    else:
        yield seen


def assembled(space: spaces.Space[Any], values: Iterator[Any]) -> Any:
    """Returns a value of a space from those of its parts, in order."""
    if isinstance(space, spaces.Dict):
        return {name: assembled(inner, values) for name, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(assembled(inner, values) for inner in space.spaces)
    return next(values)
