"""What students train on: the curricula, and all that one of your own is made of.

The contract is in :mod:`~proposer_rl.curricula.contract`, what a curriculum may ask of a student in
:mod:`~proposer_rl.curricula.student`.
"""

from proposer_rl.curricula.alp_gmm import MixtureCurriculum
from proposer_rl.curricula.batches import SomeBins
from proposer_rl.curricula.bins import BinCurriculum
from proposer_rl.curricula.buffer import (
    ReplayRule,
    draw_slots,
    empty_buffer,
    insert,
    level_keys,
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
from proposer_rl.curricula.currot import TransportCurriculum
from proposer_rl.curricula.first_order import FirstOrderCurriculum, SampledFirstOrderCurriculum
from proposer_rl.curricula.first_order_proposer import FirstOrderProposer
from proposer_rl.curricula.learning_progress import LearningProgressCurriculum
from proposer_rl.curricula.paired import PairedProposer
from proposer_rl.curricula.problem_proposer import ProblemProposer
from proposer_rl.curricula.proposer import ProposerCurriculum, ProposerTrainer
from proposer_rl.curricula.replay import ReplayCurriculum
from proposer_rl.curricula.sampling import SamplingCurriculum
from proposer_rl.curricula.scores import Scorer
from proposer_rl.curricula.selection import SelectionCurriculum
from proposer_rl.curricula.student import Student, TaskStudent, UnfitStudentError, require

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
    "replay_weights",
    "require",
    "rescore",
]
