"""What the name of a run's column tells."""

from __future__ import annotations


def is_rate(name: str) -> bool:
    """Whether a column holds shares from 0 to 1, as success is."""
    return "success" in name.split("_")


def can_reach(name: str, threshold: float) -> bool:
    """Whether a threshold makes sense for a column: a rate is above 0 and at most 1."""
    return not is_rate(name) or 0 < threshold <= 1
