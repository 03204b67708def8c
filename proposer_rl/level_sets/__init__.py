"""Named levels of any size: files of them, the set that comes along, how a Solver does there."""

from __future__ import annotations

from proposer_rl.level_sets.files import (
    SUFFIXES,
    levels_from_json,
    levels_from_text,
    levels_to_json,
    levels_to_text,
    read_levels,
    shipped_levels,
    shipped_sets,
    write_levels,
)
from proposer_rl.level_sets.pictures import draw_paths
from proposer_rl.level_sets.scores import Score, score_levels

__all__ = [
    "SUFFIXES",
    "Score",
    "draw_paths",
    "levels_from_json",
    "levels_from_text",
    "levels_to_json",
    "levels_to_text",
    "read_levels",
    "score_levels",
    "shipped_levels",
    "shipped_sets",
    "write_levels",
]
