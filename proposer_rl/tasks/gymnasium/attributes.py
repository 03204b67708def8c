"""Reads and sets an environment's attributes by dotted names such as ``model.opt.gravity.2``."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from numbers import Number
from typing import Any

import gymnasium
import numpy as np
import torch

from proposer_rl.tasks.ranges import is_real, value_text


class AttributeRefusedError(ValueError):
    """An environment has no such thing, or does not take it; the message is one line."""


def read_attribute(environment: Any, path: str) -> Any:
    """Returns what stands at a path in an environment without wrappers.

    A path is names of attributes, keys of mappings and indices, with dots in between.

    Raises:
        AttributeRefusedError: if there is nothing, listing the numbers that there are.
    """
    place = environment
    for name in path.split("."):
        try:
            key = _key(place, name)
            place = getattr(place, name) if key is None else place[key]
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise AttributeRefusedError(
                f"{type(environment).__name__} has no attribute {path!r}; numbers that it has: "
                f"{', '.join(_numbers(environment)) or 'none'}"
            ) from error
    return place


def write_attribute(environment: Any, path: str, value: Any) -> None:
    """Sets a number at a path, or a text where no number stands, and sees that it is there.

    Raises:
        AttributeRefusedError: if there is no such thing at the path, or it cannot be changed.
    """
    before = read_attribute(environment, path)
    within, _, last = path.rpartition(".")
    holder = read_attribute(environment, within) if within else environment
    new = _in_place_of(before, value, path)
    key = _key(holder, last)
    try:
        shadows = key is None and _shadows(holder, last)
        if key is None:
            setattr(holder, last, new)
        else:
            holder[key] = new
    except Exception as error:  # a setter may raise anything
        reason = " ".join(str(error).split())
        raise AttributeRefusedError(
            f"{path} of {type(environment).__name__} cannot be set to {value_text(value)}: "
            f"{type(error).__name__}: {reason}"
        ) from error
    if shadows and last in vars(holder):
        delattr(holder, last)
        raise AttributeRefusedError(
            f"{type(holder).__name__} only passes {last!r} on from something inside it, which "
            "would not see another value; name the path to it, as in name: env.gravity"
        )
    if (line := mismatch(environment, path, value)) is not None:
        raise AttributeRefusedError(line)


def mismatch(environment: Any, path: str, value: Any) -> str | None:
    """Returns a line that says what stands at a path, where it is not this value; else None.

    A wrapper that has something there by itself, beside the environment, must have the same.
    """
    for layer, now in _readings(environment, path):
        try:
            if is_real(value):
                # It may be kept in 32 bits.
                same = math.isclose(float(now), float(value), rel_tol=1e-5, abs_tol=1e-8)
            else:
                same = now is value or np.array_equal(now, value)
        except (TypeError, ValueError, RuntimeError):
            same = False
        if not same:
            return f"{path} of {type(layer).__name__} is {now}, not {value_text(value)}"
    return None


def _readings(environment: Any, path: str) -> Iterator[tuple[Any, Any]]:
    """Yields what stands at a path in an environment, and in those wrappers that have it."""
    first = path.partition(".")[0]
    while isinstance(environment, gymnasium.Wrapper):
        if hasattr(environment, first):
            with suppress(AttributeRefusedError):
                yield environment, read_attribute(environment, path)
        environment = environment.env
    yield environment, read_attribute(environment, path)


def _in_place_of(before: Any, value: Any, path: str) -> Any:
    """Returns a value of the type that it replaces: a truth value, a tensor without dimensions."""
    if not isinstance(value, int | float):
        if isinstance(before, Number):
            raise AttributeRefusedError(f"{path} is a number, {before}, and no place for {value!r}")
        return value
    shape = tuple(getattr(before, "shape", ()))
    if isinstance(before, list | tuple):
        shape = (len(before),)
    if shape:
        raise AttributeRefusedError(
            f"{path} is no number but has the shape {list(shape)}; name one of its parts, as in "
            f"name: {path}{'.0' * len(shape)}"
        )
    if isinstance(before, bool | np.bool_):
        return bool(value)
    if isinstance(before, torch.Tensor):
        return torch.full_like(before, value)
    if before is None or isinstance(before, Number | np.ndarray):
        return value
    raise AttributeRefusedError(f"{path} is no number but a {type(before).__name__}")


def _key(holder: Any, name: str) -> str | int | None:
    """Returns the key or index of an item by its name; None for an attribute."""
    if isinstance(holder, Mapping) and name in holder:
        return name
    if name.removeprefix("-").isdecimal():
        return int(name)
    return name if isinstance(holder, Mapping) else None


def _shadows(holder: Any, name: str) -> bool:
    """Returns whether an attribute is none of the object's own, which looks it up elsewhere."""
    try:
        inspect.getattr_static(holder, name)
    except AttributeError:
        return hasattr(holder, "__dict__")
    return False


def _numbers(environment: Any) -> list[str]:
    """Returns the names of an environment's own numbers."""
    found = {**vars(type(environment)), **getattr(environment, "__dict__", {})}
    return sorted(
        name
        for name, value in found.items()
        if isinstance(value, Number) and not isinstance(value, bool) and name[0] != "_"
    )
