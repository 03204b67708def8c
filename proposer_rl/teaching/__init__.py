"""Curricula in loops of one's own: a teacher, spaces of levels, TorchRL, Gymnasium, data sets."""

from __future__ import annotations

from proposer_rl.teaching.abilities import ActorStudent
from proposer_rl.teaching.gymnasium import TaughtEnv
from proposer_rl.teaching.remote import TeacherClient
from proposer_rl.teaching.sampler import TeacherSampler
from proposer_rl.teaching.spaces import Items, LevelGenerator, LevelSpace, Parameters
from proposer_rl.teaching.teacher import Teacher
from proposer_rl.teaching.torchrl import LevelTransform

__all__ = [
    "ActorStudent",
    "Items",
    "LevelGenerator",
    "LevelSpace",
    "LevelTransform",
    "Parameters",
    "TaughtEnv",
    "Teacher",
    "TeacherClient",
    "TeacherSampler",
]
