"""Converts between Gymnasium's spaces and the tensors of a Solver's network."""

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

# Spaces whose values are a number or an array of numbers.
NUMERIC = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
UNBOUNDED = 1e9  # a bound of at least this size means that there is none
IMAGE_SIDE = 16  # least side, in pixels, of an image without channels
NUMBERS_ENTRY = "observation"  # the entry of all numbers, or of the only image


class Layout:
    """Converts observations to tensors, and a Solver's actions to those of the environment.

    Observations become numbers [D], in which discrete ones are one-hot, or an image of three axes.
    If there are numbers and images, or several images, they become several entries: the numbers
    under ``observation``, and each image under ``image`` and its own name.

    Actions become one of n, one of n for each of several parts, or numbers [D], of which bounded
    ones go from -1 to 1. What is beyond a bound is clipped.

    Args:
        observation_space, action_space: of one environment.

    Attributes:
        seen: specs of the entries by name, without a batch.
        acts: spec of the actions.

    Raises:
        UnfitEnvironmentError: for a space that networks or policies cannot handle.
    """

    def __init__(
        self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self._parts: dict[str, Any] = {}  # in the order of the space
        for name, part in leaves(observation_space):
            while name in self._parts:  # a.b may be a name with a dot, or b in a
                name += "'"
            self._parts[name] = part
        for name, part in self._parts.items():
            if not isinstance(part, NUMERIC):
                way = "; use a wrapper that makes numbers of it"
                if name:
                    way = (
                        f", its part {name}; leave it out by a wrapper, as wrappers="
                        "[{gymnasium.wrappers.FilterObservation: {filter_keys: [...]}}]"
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
        """Returns a Solver's observations by entry, float32, or uint8 of bytes, [*B, ...].

        Args:
            shown: parts of observations [*B, ...], in the order of the space's parts.
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
        """Returns the parts of the environment's actions, [*B, ...] each, from a Solver's."""
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
            f"action space {space}: there is a policy for Discrete, MultiDiscrete and MultiBinary "
            "spaces, for a Box of floats, and for dictionaries and tuples of either kind; use a "
            "wrapper that makes it one of these"
        )


class PartTaken:
    """Converts numbers from -1 to 1, or choices from 0, to actions of a part of an action space.

    Attributes:
        part: the space.
        size: count of the numbers or choices.
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


def cast_to(space: Any, seen: Any) -> Any:
    """Returns an observation in the dtypes and in the order of its space.

    Raises:
        UnfitEnvironmentError: if a part has another shape, or its numbers would change. Floats may
            lie beyond the bounds, on which nothing depends here.
    """
    if isinstance(space, spaces.Dict):
        return {name: cast_to(part, seen[name]) for name, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(cast_to(part, one) for part, one in zip(space.spaces, seen, strict=True))
    if not isinstance(space, NUMERIC):
        return seen
    array, box = np.asarray(seen), isinstance(space, spaces.Box)
    fits = array.shape == space.shape and array.dtype.kind in "biuf"
    # Floats of a box are not compared one by one, which would take longer than many a step.
    floats = array.dtype.kind == "f" == space.dtype.kind
    if fits and not (box and (floats or array.dtype == space.dtype)):
        with np.errstate(invalid="ignore"):
            own = array.astype(space.dtype)
        fits = np.array_equal(own, array) and (box or space.contains(own))
    if not fits:
        raise UnfitEnvironmentError(
            f"the environment shows {shown(seen)}, {array.dtype} {list(array.shape)}; its "
            f"observation space is {space}"
        )
    return array.astype(space.dtype, copy=False)


def is_image(space: spaces.Space[Any]) -> bool:
    """Returns whether a space has images: of three or four axes, or of two long ones of bytes."""
    if not isinstance(space, spaces.Box):
        return False
    bytes_ = space.dtype == np.uint8 and min(space.shape, default=0) >= IMAGE_SIDE
    return len(space.shape) in (3, 4) or (len(space.shape) == 2 and bytes_)


def channels_first(shape: tuple[int, ...]) -> bool:
    """Returns whether the channels of an image are its first axis, and not its last.

    They are the axis that differs if the other two are alike, and else the shortest.

    Raises:
        ValueError: if the shape does not tell.

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
        f"images {list(shape)}: which axis has the channels? Set network.image=HWC or CHW"
    )


def _row(seen: Tensor, space: Any) -> Tensor:
    """Returns numbers [*B, ...] of a space as rows [*B, D], with discrete ones one-hot."""
    row = seen.reshape(*seen.shape[: seen.ndim - len(space.shape)], -1)
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        return row
    choices = zip(row.unbind(-1), np.ravel(space.start).tolist(), _options(space), strict=True)
    hot = [x[..., None] == torch.arange(s, s + n, device=x.device) for x, s, n in choices]
    return torch.cat(hot, -1)


def _options(space: Any) -> list[int]:
    """Returns the number of options of each choice."""
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
    """Yields the parts in nested dictionaries and tuples, with their dotted names."""
    if isinstance(whole, Mapping | tuple | spaces.Tuple):  # a space of dictionaries is a Mapping
        for part, inner in whole.items() if isinstance(whole, Mapping) else enumerate(whole):
            yield from leaves(inner, f"{name}.{part}" if name else str(part))
    else:
        yield name, whole


def in_order(space: spaces.Space[Any], seen: Any) -> Iterator[Any]:
    """Yields the parts of an observation in the order of its space's parts."""
    if isinstance(space, spaces.Dict):
        for name, inner in space.spaces.items():
            yield from in_order(inner, seen[name])
    elif isinstance(space, spaces.Tuple):
        for inner, one in zip(space.spaces, seen, strict=True):
            yield from in_order(inner, one)
    else:
        yield seen


def assembled(space: spaces.Space[Any], values: Iterator[Any]) -> Any:
    """Returns a value of a space, put together from the values of its parts in order."""
    if isinstance(space, spaces.Dict):
        return {name: assembled(inner, values) for name, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(assembled(inner, values) for inner in space.spaces)
    return next(values)
