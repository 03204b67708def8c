"""Describes what a teacher's state belongs to, and compares descriptions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from proposer_rl.curricula import Curriculum
from proposer_rl.curricula.combinators import Combinator
from proposer_rl.settings import ArgumentError
from proposer_rl.task import Levels, level_inputs


def of_levels(space: Any, like: Levels) -> dict[str, Any]:
    """Describes a space or task, and its levels by an example: numbers and texts for JSON."""
    levels: dict[str, Any] = {
        name: f"{one.dtype} {list(one.shape)}" for name, one in like.flatten_keys(".").items()
    }
    levels["number of features"] = level_inputs(space.space, like.unsqueeze(0)).shape[-1]
    known = getattr(space, "description", {})
    return {"kind": type(space).__qualname__, **known, "levels": levels}


def of_classes(curriculum: Curriculum) -> str:
    """Returns the names of the classes of a curriculum and its parts."""
    parts = curriculum.parts if isinstance(curriculum, Combinator) else []
    within = f"({', '.join(map(of_classes, parts))})" if parts else ""
    return type(curriculum).__qualname__ + within


def require_same(what: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Compares the description in a state with the present one.

    Raises:
        ArgumentError: with the first difference, if there is one.
    """
    old, new = dict(_flat(before)), dict(_flat(now))
    for name in {**old, **new}:
        was, is_ = old.get(name, "missing"), new.get(name, "missing")
        if was != is_:
            raise ArgumentError(
                f"state: belongs to another {what}: {name} was {was!s:.60}, is {is_!s:.60}"
            )


def _flat(description: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in description.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
