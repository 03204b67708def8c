"""What the name of a run's column tells."""

from __future__ import annotations


def is_rate(name: str) -> bool:
    """Whether a column holds shares from 0 to 1, as success is."""
    return "success" in name.split("_")
