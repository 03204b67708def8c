"""Numbers from settings: wrong ones are refused in one line that names them."""

from __future__ import annotations

import math
from typing import Any

MOST = 1_000_000
"""Of what is counted: more would not fit in memory, or never come to pass."""


def whole(name: str, value: Any, least: int) -> int:
    """The value, if it is a whole number from ``least`` to :data:`MOST`.

    Raises:
        ValueError: otherwise.
    """
    if type(value) is not int or not least <= value <= MOST:
        raise ValueError(f"{name} must be a whole number from {least} to {MOST:,}, got {value!r}")
    return value


def real(name: str, value: Any, *, least: float | None = None, above: float = -math.inf) -> float:
    """The value as a float, if it is a finite number, not below ``least`` and above ``above``.

    Raises:
        ValueError: otherwise.
    """
    asked = "a finite number"
    if least is not None:
        asked = f"a finite number of at least {least:g}"
    elif above > -math.inf:
        asked = f"a finite number above {above:g}"
    wrong = isinstance(value, bool) or not isinstance(value, int | float)
    if wrong or not math.isfinite(value) or value <= above or (least is not None and value < least):
        raise ValueError(f"{name} must be {asked}, got {value!r}")
    return float(value)


def part(name: str, value: Any, *, below_one: bool = False, above_zero: bool = False) -> float:
    """The value as a float, if it is from 0, or above 0, to 1, or to below 1.

    Raises:
        ValueError: otherwise.
    """
    fits = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1
    if not fits or (below_one and value == 1) or (above_zero and value == 0):
        least = "above" if above_zero else "from"
        raise ValueError(f"{name} must be {least} 0 to {'below ' * below_one}1, got {value!r}")
    return float(value)


def flag(name: str, value: Any) -> bool:
    """The value, if it is true or false.

    Raises:
        ValueError: otherwise.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be true or false, got {value!r}")
    return value


def one_of(name: str, value: Any, known: tuple[str, ...]) -> str:
    """The value, if it is among the known ones.

    Raises:
        ValueError: otherwise.
    """
    if value not in known:
        raise ValueError(f"{name} must be {' or '.join(known)}, got {value!r}")
    return str(value)
