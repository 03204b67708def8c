"""What students train on: the curricula, and all that one of your own is made of.

The contract is in :mod:`~proposer_rl.curricula.contract`, what a curriculum may ask of a student in
:mod:`~proposer_rl.curricula.student`. ``curricula.plr()``, ``curricula.currot()`` and so on are
recipes, named as the files of ``conf/method`` and with their settings, for
:func:`proposer_rl.train`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from proposer_rl.curricula.batches import SomeBins, level_keys
from proposer_rl.curricula.bins import BinCurriculum
from proposer_rl.curricula.buffer import (
    ReplayRule,
    draw_slots,
    empty_buffer,
    insert,
    replay_weights,
    rescore,
)
from proposer_rl.curricula.combinators import Filtered, Mixed, Schedule
from proposer_rl.curricula.contract import (
    Advance,
    Batch,
    Curriculum,
    Improvement,
    Inbox,
    LearnedCurriculum,
    outcome_of,
)
from proposer_rl.curricula.first_order import FirstOrderCurriculum, SampledFirstOrderCurriculum
from proposer_rl.curricula.gaussians import MixtureCurriculum
from proposer_rl.curricula.modelled import Modelled
from proposer_rl.curricula.problem_proposer import ProblemProposer
from proposer_rl.curricula.problem_rewards import FirstOrderProposer, PairedProposer
from proposer_rl.curricula.progress import LearningProgressCurriculum
from proposer_rl.curricula.proposer import ProposerCurriculum, ProposerTrainer
from proposer_rl.curricula.replay import ReplayCurriculum
from proposer_rl.curricula.sampling import SamplingCurriculum
from proposer_rl.curricula.scores import Scorer
from proposer_rl.curricula.selection import SelectionCurriculum
from proposer_rl.curricula.student import Student, TaskStudent, UnfitStudentError, require
from proposer_rl.curricula.transport import TransportCurriculum
from proposer_rl.recipes import Recipe, available, own_recipe, recipe_function

__all__ = [
    "Advance",
    "Batch",
    "BinCurriculum",
    "Curriculum",
    "Filtered",
    "FirstOrderCurriculum",
    "FirstOrderProposer",
    "Improvement",
    "Inbox",
    "LearnedCurriculum",
    "LearningProgressCurriculum",
    "Mixed",
    "MixtureCurriculum",
    "Modelled",
    "PairedProposer",
    "ProblemProposer",
    "ProposerCurriculum",
    "ProposerTrainer",
    "ReplayCurriculum",
    "ReplayRule",
    "SampledFirstOrderCurriculum",
    "SamplingCurriculum",
    "Schedule",
    "Scorer",
    "SelectionCurriculum",
    "SomeBins",
    "Student",
    "TaskStudent",
    "TransportCurriculum",
    "UnfitStudentError",
    "draw_slots",
    "empty_buffer",
    "insert",
    "level_keys",
    "outcome_of",
    "own",
    "replay_weights",
    "require",
    "rescore",
]


def own(make: Callable[..., Any], **settings: Any) -> Recipe:
    """A curriculum of one's own: see :func:`proposer_rl.recipes.own_recipe`."""
    return own_recipe("method", make, **settings)


def __getattr__(name: str) -> Callable[..., Recipe]:
    return recipe_function("method", name)


def __dir__() -> list[str]:
    return [*available("method"), *__all__]
