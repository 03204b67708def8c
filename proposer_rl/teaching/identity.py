"""Describes what a teacher's state belongs to, and compares descriptions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from proposer_rl.curricula import Curriculum
from proposer_rl.curricula.combinators import Combinator
from proposer_rl.settings import ArgumentError
from proposer_rl.task import Levels, level_inputs

SHOWN = 3  # number of differences in an error


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
        ArgumentError: if they differ, naming what.
    """
    old, new = dict(_flat(before)), dict(_flat(now))
    differ = [name for name in {**old, **new} if old.get(name, ...) != new.get(name, ...)]
    # If anything else differs, it explains differences in the entries of levels.
    differ = [name for name in differ if not name.startswith("levels.")] or differ
    if differ:
        lines = [
            f"{name} was {old.get(name, 'missing')!s:.60}, is {new.get(name, 'missing')!s:.60}"
            for name in differ[:SHOWN]
        ]
        more = f"; and {len(differ) - SHOWN} more" if len(differ) > SHOWN else ""
        raise ArgumentError(f"state: belongs to another {what}: {'; '.join(lines)}{more}")


def _flat(description: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in description.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
