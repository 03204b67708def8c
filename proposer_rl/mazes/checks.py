"""What is wrong with a task's settings: one line that names the key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def named(key: str, make: Any, *arguments: Any) -> Any:
    """Make something, naming the key in whatever is wrong with its value."""
    try:
        return make(*arguments)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from error


def check_names(known: Mapping[str, Any], target: str, measured: Sequence[str]) -> None:
    """Refuse names of distributions that there are not."""
    for key, names in (("target", [target]), ("evaluation.distributions", measured)):
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(f"{key}: must be among {sorted(known)}, got {unknown[0]!r}")
