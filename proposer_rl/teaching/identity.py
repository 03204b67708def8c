"""Describes what a teacher's state belongs to, and how two descriptions differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from proposer_rl.curricula import Curriculum
from proposer_rl.curricula.combinators import Combinator
from proposer_rl.settings import ArgumentError
from proposer_rl.task import Levels, level_inputs

SHOWN = 3  # differences in one line
LONGEST = 60  # of a value in it


def of_levels(space: Any, like: Levels) -> dict[str, Any]:
    """Describes a space or task, and its levels by one of them: numbers and texts for JSON."""
    entries = {
        ".".join([name] if isinstance(name, str) else name): like.get(name)
        for name in like.keys(True, True)
    }
    levels: dict[str, Any] = {
        name: f"{one.dtype} {list(one.shape)}" for name, one in entries.items()
    }
    levels["number of features"] = level_inputs(space.space, like.unsqueeze(0)).shape[-1]
    known = getattr(space, "description", {"kind": type(space).__qualname__})
    return {**known, "levels": levels}


def of_classes(curriculum: Curriculum) -> str:
    """Returns the name of a curriculum's class, and those of its parts."""
    parts = curriculum.parts if isinstance(curriculum, Combinator) else []
    within = f"({', '.join(map(of_classes, parts))})" if parts else ""
    return type(curriculum).__qualname__ + within


def require_same(what: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuses a state that belongs to another space, task or curriculum.

    Raises:
        ArgumentError: naming what differs.
    """
    old, new = dict(_flat(before)), dict(_flat(now))
    if old.get("kind") != new.get("kind"):
        old, new = ({"kind": one.get("kind")} for one in (old, new))
    differ = [name for name in {**old, **new} if old.get(name, ...) != new.get(name, ...)]
    # Entries of levels follow from the rest, where that is known.
    differ = [name for name in differ if not name.startswith("levels.")] or differ
    if differ:
        lines = [f"{name} was {_said(old, name)}, is {_said(new, name)}" for name in differ[:SHOWN]]
        more = f"; and {len(differ) - SHOWN} more" if len(differ) > SHOWN else ""
        raise ArgumentError(f"state: of another {what}: {'; '.join(lines)}{more}")


def _flat(description: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in description.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _said(description: Mapping[str, Any], name: str) -> str:
    text = str(description[name]) if name in description else "missing"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
