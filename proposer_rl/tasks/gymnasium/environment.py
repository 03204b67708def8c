"""Sets and reads an environment's attributes, and reads what its steps return."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from numbers import Number
from typing import Any, Literal

import numpy as np
import torch

from proposer_rl.settings import ArgumentError, settings, shown
from proposer_rl.tasks.ranges import is_real, value_text

ROUNDING = 1e-6  # of a sum of rewards, relative: ten times 0.1 is 0.9999999999999999


class UnfitEnvironmentError(ValueError):
    """An environment cannot be made, set, read or stepped; the message is one line."""

    exit_code = 2


def read_attribute(environment: Any, path: str) -> Any:
    """Returns the value at a dotted path in an environment, such as ``model.opt.gravity.2``.

    Args:
        environment: without wrappers.
        path: attribute names, keys of mappings and indices, joined by dots.

    Raises:
        UnfitEnvironmentError: if there is nothing at the path, listing the environment's numbers.
    """
    place = environment
    for name in path.split("."):
        try:
            key = _key(place, name)
            place = getattr(place, name) if key is None else place[key]
        except (AttributeError, LookupError, TypeError, ValueError) as error:
            raise UnfitEnvironmentError(
                f"{type(environment).__name__} has no attribute {path!r}; numbers that it has: "
                f"{', '.join(_numbers(environment)) or 'none'}"
            ) from error
    return place


def write_attribute(environment: Any, path: str, value: Any) -> None:
    """Sets the value at a path (see :func:`read_attribute`), and reads it back.

    Raises:
        UnfitEnvironmentError: if nothing of the value's kind is at the path, or the new value
            is not there afterwards or would have no effect.
        Exception: what the environment raises when it is set.
    """
    before = read_attribute(environment, path)
    within, _, last = path.rpartition(".")
    holder = read_attribute(environment, within) if within else environment
    new = _in_place_of(before, value, path)
    key = _key(holder, last)
    forwards = key is None and _forwards(holder, last)
    if key is None:
        setattr(holder, last, new)
    else:
        holder[key] = new
    if forwards and last in vars(holder):
        delattr(holder, last)
        raise UnfitEnvironmentError(
            f"{type(holder).__name__} only passes {last!r} on from an object inside it, which "
            "would not see a new value; give the path to that object, as in name: env.gravity"
        )
    if (line := mismatch(environment, path, value)) is not None:
        raise UnfitEnvironmentError(line)


def mismatch(environment: Any, path: str, value: Any) -> str | None:
    """Describes in a line how the value at a path differs from this one; None where it does not."""
    inner = environment.unwrapped
    now = read_attribute(inner, path)
    try:
        if is_real(value):
            # It may be kept in 32 bits.
            same = math.isclose(float(now), float(value), rel_tol=1e-5, abs_tol=1e-8)
        else:
            same = now is value or np.array_equal(now, value)
    except (TypeError, ValueError, RuntimeError):
        same = False
    return None if same else f"{path} of {type(inner).__name__} is {now}, not {value_text(value)}"


def _in_place_of(before: Any, value: Any, path: str) -> Any:
    """Returns a value in the type of the one that it replaces, such as a truth value's."""
    shape = (len(before),) if isinstance(before, list | tuple) else getattr(before, "shape", ())
    if isinstance(value, int | float):
        single = Number | np.bool_ | np.ndarray | torch.Tensor | None
        fits = isinstance(before, single) and not len(shape)
    else:
        fits = not isinstance(before, Number)
    if not fits:
        part = f"; name one of its parts, as in name: {path}{'.0' * len(shape)}" * bool(shape)
        raise UnfitEnvironmentError(
            f"{path} is {shown(before)}, no place for {value_text(value)}{part}"
        )
    if isinstance(before, bool | np.bool_):
        return bool(value)
    return torch.full_like(before, value) if isinstance(before, torch.Tensor) else value


def _key(holder: Any, name: str) -> str | int | None:
    """Returns the key or index of an item by its name; None for an attribute."""
    if isinstance(holder, Mapping) and name in holder:
        return name
    if name.removeprefix("-").isdecimal():
        return int(name)
    return name if isinstance(holder, Mapping) else None


def _forwards(holder: Any, name: str) -> bool:
    """Returns whether an object looks an attribute up elsewhere, as by ``__getattr__``."""
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


def entries(info: Mapping[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """Yields an info's entries by name, with those of nested mappings, as ``metrics.won``."""
    for name, value in info.items():
        yield f"{within}{name}", value
        if isinstance(value, Mapping):
            yield from entries(value, f"{within}{name}.")


@settings
class SuccessSettings:
    """Decides when an episode is a success.

    Attributes:
        kind: ``return``: its return is at least ``least``; ``survived``: only the time limit ended
            it; ``terminated``: the environment ended it; ``info``: an entry of its last info is
            true.
        least: the return.
        key: the entry's name; dots lead into nested mappings.
        optional: whether the entry may be missing, which then means no success.
        once: whether the entry may be true in any step, so that a success that is lost again
            counts.
    """

    kind: Literal["return", "survived", "terminated", "info"]
    least: float | None = None
    key: str | None = None
    optional: bool = False
    once: bool = False

    def __post_init__(self) -> None:
        needed = {"return": "least", "info": "key"}.get(self.kind)
        if needed and getattr(self, needed) is None:
            raise ArgumentError(f"{needed}: missing with kind={self.kind}")

    def __call__(
        self,
        terminated: bool,
        truncated: bool,
        in_time: bool,
        returns: float,
        info: Mapping[str, Any],
    ) -> bool:
        """Returns whether an episode with this last step, or with ``once`` any step, is a success.

        Args:
            terminated: whether the environment ended the episode.
            truncated: whether it was cut off.
            in_time: whether the time limit had not been reached.
            returns: sum of the episode's rewards.
            info: of the environment.

        Raises:
            UnfitEnvironmentError: if the entry is not a truth value, or an episode's last info has
                no such entry, listing those that there are.
        """
        if self.kind == "return":
            least = self.least or 0.0
            return returns >= least or math.isclose(returns, least, rel_tol=ROUNDING)
        if self.kind == "survived":
            return not terminated and not in_time
        if self.kind == "terminated":
            return terminated
        known = dict(entries(info))
        value = known.get(self.key or "")
        if value is not None:
            if np.size(value) != 1 or np.asarray(value).item() not in (0, 1):
                raise UnfitEnvironmentError(
                    f"success.key={self.key}: the entry of the info must be true or false, not "
                    f"{shown(value)}"
                )
            return bool(np.asarray(value).item())
        if not self.optional and (terminated or truncated):
            raise UnfitEnvironmentError(
                f"success.key={self.key}: the last info of an episode has no such entry; it has: "
                f"{', '.join(known) or 'none'}; where only episodes that succeed have it, set "
                "success.optional=true"
            )
        return False
