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

from proposer_rl.settings import shown
from proposer_rl.tasks.gymnasium.answers import UnfitEnvironmentError

Array = NDArray[Any]
Env = gymnasium.Env[Any, Any]

# Spaces whose values are one number or an array of them.
NUMERIC = spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary
UNBOUNDED = 1e9  # what a bound of at least this means; no number in use comes near
IMAGE_SIDE = 16  # pixels at least, of a map of bytes without channels
NUMBERS_ENTRY = "observation"  # the entry of all numbers, or of the only image


def plain_env(env: Env) -> Env:
    """Returns an environment whose observations and actions are plain arrays.

    Observations become a box: of numbers [D], where whole numbers to choose from are one-hot; or of
    an image of three axes. Where both are seen, or several images, they are a dictionary of boxes:
    the numbers by the name of ``observation``, each image by its own after ``image``.

    Actions become one of n, one of several n each, or a box [D] whose bounded parts go from -1 to
    1; what is beyond a bound is clipped.

    Raises:
        UnfitEnvironmentError: for spaces that no network is for, saying what there is one for.
    """
    return _with_plain_observations(_with_plain_actions(env))


def _with_plain_observations(env: Env) -> Env:
    space = env.observation_space
    if isinstance(space, spaces.Box) and len(space.shape) == (3 if is_image(space) else 1):
        return TransformObservation(env, partial(_typed, space), space)
    parts, images, rest = observation_parts(space)
    new: dict[str, spaces.Space[Any]] = {}
    for name, box in images.items():
        low, high = (_of_three_axes(end) for end in (box.low, box.high))
        new[f"image {name}"] = spaces.Box(low, high, dtype=cast(Any, box.dtype.type))
    if rest.spaces:
        new[NUMBERS_ENTRY] = spaces.flatten_space(rest)

    def changed(seen: Any) -> Any:
        read = zip(parts.items(), in_order(space, seen), strict=True)
        shown = {name: _typed(part, own) for (name, part), own in read}
        out: dict[str, Any] = {f"image {name}": _of_three_axes(shown[name]) for name in images}
        if rest.spaces:
            out[NUMBERS_ENTRY] = spaces.flatten(rest, {name: shown[name] for name in rest.spaces})
        return out if len(out) > 1 else next(iter(out.values()))

    together = spaces.Dict(new) if len(new) > 1 else next(iter(new.values()))
    return TransformObservation(env, changed, together)


def observation_parts(
    space: spaces.Space[Any],
) -> tuple[dict[str, spaces.Space[Any]], dict[str, spaces.Box], spaces.Dict]:
    """Returns all parts of an observation space by dotted names, its images, and its numbers.

    Raises:
        UnfitEnvironmentError: for a part that no network is for.
    """
    parts: dict[str, spaces.Space[Any]] = {}
    for name, part in leaves(space):
        while name in parts:  # a.b is a name with a dot, or b in a
            name += "'"
        parts[name] = part
    for name, part in parts.items():
        if not isinstance(part, NUMERIC):
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
    return parts, images, rest


def _typed(space: Any, seen: Any) -> Array:
    """Returns an observation in the type of its space, of numbers.

    Raises:
        UnfitEnvironmentError: where it has another shape, or would become another number. A float
            beyond its bounds does not: nothing here depends on them.
    """
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
    typed: Array = array.astype(space.dtype, copy=False)
    return typed


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


def _of_three_axes(image: Array) -> Array:
    """Returns a grey image with an axis of channels, stacked images with theirs along it."""
    if image.ndim == 2:
        return image[..., None]
    if image.ndim == 3:
        return image
    if channels_first(image.shape[1:]):
        return image.reshape(-1, *image.shape[2:])
    return image.transpose(1, 2, 0, 3).reshape(*image.shape[1:3], -1)


def _with_plain_actions(env: Env) -> Env:
    space = env.action_space
    if isinstance(space, spaces.Discrete):
        return env
    parts = [part for _, part in leaves(space)]
    new: spaces.Space[Any]
    read: list[Callable[[Array], Any]]
    if all(isinstance(part, spaces.Box) and part.dtype.kind == "f" for part in parts):
        boxes = [Scaled(cast(spaces.Box, part)) for part in parts]
        read, least = [*boxes], [box.least for box in boxes]
        new = spaces.Box(np.concatenate(least), -np.concatenate(least))
        sizes = [len(part) for part in least]
    elif all(isinstance(part, NUMERIC) and not isinstance(part, spaces.Box) for part in parts):
        options = [_options(part) for part in parts]
        new = spaces.MultiDiscrete(np.concatenate(options))
        sizes = [len(part) for part in options]
        read = [partial(_chosen, part) for part in parts]
    else:
        raise UnfitEnvironmentError(
            f"action space {space}: there is a policy for a Discrete, a MultiDiscrete or a "
            "MultiBinary one, for a Box of floats, and for dictionaries and tuples of either; a "
            "wrapper can make it one"
        )
    ends = np.cumsum(sizes)[:-1]

    def changed(action: Array) -> Any:
        own = [make(part) for make, part in zip(read, np.split(action, ends), strict=True)]
        return assembled(space, iter(own))

    return TransformAction(env, changed, new)


class Scaled:
    """Makes numbers from -1 to 1 those of a box; unbounded ones stay as they are.

    Attributes:
        low, high, middle, reach: an action is ``middle + reach * number``, clipped to the bounds.
        least: of the numbers.
    """

    def __init__(self, box: spaces.Box) -> None:
        self.box = box
        low, high = (end.astype(np.float64).ravel() for end in (box.low, box.high))
        self.low, self.high = low, high
        bounded = (low > -UNBOUNDED) & (high < UNBOUNDED)
        first, last = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
        self.middle, self.reach = (first + last) / 2, (last - first) / 2
        self.least = np.where(bounded, -1.0, -np.inf).astype(np.float32)

    def __call__(self, action: Array) -> Array:
        """Returns an action of the box, from numbers in one row."""
        scaled = (self.middle + self.reach * action).clip(self.low, self.high)
        return scaled.astype(self.box.dtype).reshape(self.box.shape)


def _options(space: spaces.Space[Any]) -> Array:
    """Returns how many options each choice has."""
    if isinstance(space, spaces.Discrete):
        return np.array([space.n])
    if isinstance(space, spaces.MultiDiscrete):
        return space.nvec.ravel()
    return np.full(int(np.prod(space.shape or ())), 2)


def _chosen(space: spaces.Space[Any], choices: Array) -> Any:
    """Returns what choices counted from 0 are in a space."""
    if isinstance(space, spaces.Discrete):
        return int(choices[0] + space.start)
    shaped = choices.reshape(space.shape)
    start = space.start if isinstance(space, spaces.MultiDiscrete) else 0
    return (shaped + start).astype(space.dtype)


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
