"""Curricula, and the parts from which you can write your own.

The contract is in :mod:`~proposer_rl.curricula.contract`, what a curriculum may ask of a student in
:mod:`~proposer_rl.curricula.student`. ``curricula.plr()``, ``curricula.currot()`` and so on are
recipes, named as the files of ``conf/method`` and with their settings, for
:func:`proposer_rl.train`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from proposer_rl.curricula.adaptive import AdaptiveMixture as AdaptiveMixture
from proposer_rl.curricula.automatic_randomization import BoundsCurriculum as BoundsCurriculum
from proposer_rl.curricula.bins import BinCurriculum as BinCurriculum
from proposer_rl.curricula.buffer import ReplayRule as ReplayRule
from proposer_rl.curricula.combinators import Filtered as Filtered
from proposer_rl.curricula.combinators import Mixed as Mixed
from proposer_rl.curricula.combinators import Schedule as Schedule
from proposer_rl.curricula.contract import Batch as Batch
from proposer_rl.curricula.contract import Curriculum as Curriculum
from proposer_rl.curricula.contract import LearnedCurriculum as LearnedCurriculum
from proposer_rl.curricula.contract import outcome_of as outcome_of
from proposer_rl.curricula.first_order import FirstOrderCurriculum as FirstOrderCurriculum
from proposer_rl.curricula.gaussian_mixtures import MixtureCurriculum as MixtureCurriculum
from proposer_rl.curricula.items import AdaptiveDifficulty as AdaptiveDifficulty
from proposer_rl.curricula.items import ArcLengthFilter as ArcLengthFilter
from proposer_rl.curricula.items import BetaSampling as BetaSampling
from proposer_rl.curricula.items import CategoryBandit as CategoryBandit
from proposer_rl.curricula.optimal_transport import TransportCurriculum as TransportCurriculum
from proposer_rl.curricula.outcome_model import Modelled as Modelled
from proposer_rl.curricula.problem_proposer import FirstOrderProposer as FirstOrderProposer
from proposer_rl.curricula.problem_proposer import PairedProposer as PairedProposer
from proposer_rl.curricula.problem_proposer import ProblemProposer as ProblemProposer
from proposer_rl.curricula.progress import LearningProgressCurriculum as LearningProgressCurriculum
from proposer_rl.curricula.proposer import ProposerCurriculum as ProposerCurriculum
from proposer_rl.curricula.proposer import ProposerTrainer as ProposerTrainer
from proposer_rl.curricula.replay import ReplayCurriculum as ReplayCurriculum
from proposer_rl.curricula.sampling import SamplingCurriculum as SamplingCurriculum
from proposer_rl.curricula.sampling import SelectionCurriculum as SelectionCurriculum
from proposer_rl.curricula.scores import Scorer as Scorer
from proposer_rl.curricula.self_paced import SelfPacedCurriculum as SelfPacedCurriculum
from proposer_rl.curricula.student import Student as Student
from proposer_rl.curricula.student import TaskStudent as TaskStudent
from proposer_rl.curricula.student import UnfitStudentError as UnfitStudentError
from proposer_rl.curricula.student import require as require
from proposer_rl.curricula.terrain import RowsCurriculum as RowsCurriculum
from proposer_rl.recipes import Recipe, available, own_recipe, recipe_function


def own(make: Callable[..., Any], **settings: Any) -> Recipe:
    """Returns a recipe for a curriculum of your own; see :func:`proposer_rl.recipes.own_recipe`."""
    return own_recipe("method", make, **settings)


def __getattr__(name: str) -> Callable[..., Recipe]:
    return recipe_function("method", name, Modelled.around)


def __dir__() -> list[str]:
    here = [
        name
        for name, value in globals().items()
        if getattr(value, "__module__", "").startswith(__name__) and not name.startswith("_")
    ]
    return [*available("method"), *here]
