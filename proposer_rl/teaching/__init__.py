"""Curricula in loops of one's own: a teacher, spaces of levels, TorchRL, Gymnasium, prompts."""

from __future__ import annotations

from proposer_rl.teaching.spaces import Items, LevelGenerator, LevelSpace, Parameters
from proposer_rl.teaching.teacher import Teacher

__all__ = ["Items", "LevelGenerator", "LevelSpace", "Parameters", "Teacher"]
