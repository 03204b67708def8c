"""Spaces as Solvers' networks take them: numbers, images, and actions in one array."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformAction, TransformObservation
from numpy.typing import NDArray

from proposer_rl.tasks.gymnasium.answers import UnfitEnvironmentError, check_seen

Array = NDArray[Any]
Change = tuple[Callable[[Any], Any], spaces.Space[Any]]

UNBOUNDED = 1e9  # what a bound of at least this means; no number in use comes near
IMAGE_SIDE = 16  # pixels at least, of a map of bytes without channels
NUMBERS = "observation"  # the entry of all numbers, or of the only image


def plain(env: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """An environment whose observations and actions are plain arrays.

    Observations become a box: of numbers [D], where whole numbers to choose from are one-hot; or of
    an image of three axes. Where both are seen, or several images, they are a dictionary of boxes:
    the numbers by the name of ``observation``, each image by its own after ``image``.

    Actions become one of n, one of several n each, or a box [D] whose bounded parts go from -1 to
    1; what is beyond a bound is clipped.

    Raises:
        UnfitEnvironmentError: for spaces that no network is for, saying what there is one for.
    """
    acts = _actions(env.action_space)
    if acts is not None:
        env = TransformAction(env, *acts)
    seen = _observations(env.observation_space)
    return env if seen is None else TransformObservation(env, *seen)


def _observations(space: spaces.Space[Any]) -> Change | None:
    """What makes observations plain, and their space; None where they are.

    Any numbers are floats to a vector environment, which keeps whole ones only of their own type.
    """
    if isinstance(space, spaces.Box) and len(space.shape) == (3 if is_image(space) else 1):
        return (partial(_typed, space), space) if space.dtype.kind in "biu" else None
    parts = dict(leaves(space))
    for name, part in parts.items():
        if not isinstance(
            part, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
        ):
            way = "; a wrapper can make numbers of it"
            if name:
                way = (
                    f", its part {name}; a wrapper can leave it out, as "
                    "wrappers=[{gymnasium.wrappers.FilterObservation: {filter_keys: [...]}}] does"
                )
            raise UnfitEnvironmentError(
                f"observation space {space}: there is no network for {part}{way}"
            )
    images = {name: cast(spaces.Box, part) for name, part in parts.items() if is_image(part)}
    rest = spaces.Dict({name: part for name, part in parts.items() if name not in images})

    def changed(seen: Any) -> Any:
        shown = dict(values(seen))
        out: dict[str, Any] = {
            f"image {name}": _of_three_axes(_typed(box, shown[name]))
            for name, box in images.items()
        }
        if rest.spaces:
            out[NUMBERS] = spaces.flatten(rest, {name: shown[name] for name in rest.spaces})
        return out if len(out) > 1 else next(iter(out.values()))

    return changed, _space_of(images, rest)


def _typed(space: spaces.Box, seen: Any) -> Array:
    """An observation in the type of its box.

    Raises:
        UnfitEnvironmentError: where a whole number would become another.
    """
    array = np.asarray(seen)
    if array.dtype != space.dtype and space.dtype.kind in "biu":
        check_seen(space, array, "the environment")
    return array.astype(space.dtype, copy=False)


def _space_of(images: Mapping[str, spaces.Box], rest: spaces.Dict) -> spaces.Space[Any]:
    new: dict[str, spaces.Space[Any]] = {}
    for name, part in images.items():
        low, high = (_of_three_axes(end) for end in (part.low, part.high))
        new[f"image {name}"] = spaces.Box(low, high, dtype=cast(Any, part.dtype.type))
    if rest.spaces:
        new[NUMBERS] = spaces.flatten_space(rest)
    return spaces.Dict(new) if len(new) > 1 else next(iter(new.values()))


def is_image(space: spaces.Space[Any]) -> bool:
    """Whether a space is of images: three axes or four, or two of bytes and not short."""
    if not isinstance(space, spaces.Box):
        return False
    bytes_ = space.dtype == np.uint8 and min(space.shape, default=0) >= IMAGE_SIDE
    return len(space.shape) in (3, 4) or (len(space.shape) == 2 and bytes_)


def channels_first(shape: tuple[int, ...]) -> bool:
    """Whether the channels of an image are its first axis, or else its last.

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


def _of_three_axes(image: Array) -> Array:
    """Grey images get an axis of channels; of stacked images it is that of the stack, too."""
    if image.ndim == 2:
        return image[..., None]
    if image.ndim == 3:
        return image
    if channels_first(image.shape[1:]):
        return image.reshape(-1, *image.shape[2:])
    return image.transpose(1, 2, 0, 3).reshape(*image.shape[1:3], -1)


def _actions(space: spaces.Space[Any]) -> Change | None:
    """What makes actions of plain ones, and the space of those; None where they are plain."""
    if isinstance(space, spaces.Discrete):
        return None
    parts = dict(leaves(space))
    if all(_is_continuous(part) for part in parts.values()):
        boxes = [_Scaled(cast(spaces.Box, part)) for part in parts.values()]
        new: spaces.Space[Any] = spaces.Box(
            np.concatenate([box.least for box in boxes]),
            np.concatenate([-box.least for box in boxes]),
        )
        sizes = [len(box.least) for box in boxes]
        read: list[Callable[[Array], Any]] = [*boxes]
    elif all(_is_choice(part) for part in parts.values()):
        options = [_options(part) for part in parts.values()]
        new = spaces.MultiDiscrete(np.concatenate(options))
        sizes = [len(part) for part in options]
        read = [partial(_chosen, part) for part in parts.values()]
    else:
        raise UnfitEnvironmentError(
            f"action space {space}: there is a policy for a Discrete, a MultiDiscrete or a "
            "MultiBinary one, for a Box of floats, and for dictionaries and tuples of either; a "
            "wrapper can make it one"
        )
    ends = np.cumsum(sizes)[:-1]

    def changed(action: Array) -> Any:
        own = [make(part) for make, part in zip(read, np.split(action, ends), strict=True)]
        return _composed(space, iter(own))

    return changed, new


class _Scaled:
    """Numbers from -1 to 1 as those of a box; unbounded ones as they are."""

    def __init__(self, box: spaces.Box) -> None:
        self._box = box
        low, high = (end.astype(np.float64).ravel() for end in (box.low, box.high))
        self._low, self._high = low, high
        above, below = low > -UNBOUNDED, high < UNBOUNDED
        both = above & below
        self._middle = np.where(both, (np.where(both, low, 0) + np.where(both, high, 0)) / 2, 0.0)
        self._reach = np.where(both, np.where(both, high, 2) - np.where(both, low, 0), 2.0) / 2
        self.least = np.where(both, -1.0, -np.inf).astype(np.float32)

    def __call__(self, action: Array) -> Array:
        scaled = (self._middle + self._reach * action).clip(self._low, self._high)
        return scaled.astype(self._box.dtype).reshape(self._box.shape)


def _is_continuous(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating)


def _is_choice(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)


def _options(space: spaces.Space[Any]) -> Array:
    """How many there are of each choice."""
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel()
    return np.full(int(np.prod(space.shape or ())), 2)


def _chosen(space: spaces.Space[Any], choices: Array) -> Any:
    """What choices counted from 0 are in a space."""
    if isinstance(space, spaces.Discrete):
        return int(choices[0] + space.start)
    shaped = choices.reshape(space.shape)
    start = space.start if isinstance(space, spaces.MultiDiscrete) else 0
    return (shaped + start).astype(space.dtype)


def leaves(space: spaces.Space[Any], name: str = "") -> Iterator[tuple[str, spaces.Space[Any]]]:
    """The parts of a space that are no dictionaries or tuples, by their dotted names."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        within = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for part, inner in within:
            yield from leaves(inner, f"{name}.{part}" if name else str(part))
    else:
        yield name, space


def values(seen: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The parts of an observation that are no dictionaries or tuples, by their dotted names."""
    if isinstance(seen, Mapping | tuple):
        for part, inner in seen.items() if isinstance(seen, Mapping) else enumerate(seen):
            yield from values(inner, f"{name}.{part}" if name else str(part))
    else:
        yield name, seen


def _composed(space: spaces.Space[Any], values: Iterator[Any]) -> Any:
    """A value of a space from those of its parts, in order."""
    if isinstance(space, spaces.Dict):
        return {name: _composed(inner, values) for name, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_composed(inner, values) for inner in space.spaces)
    return next(values)
