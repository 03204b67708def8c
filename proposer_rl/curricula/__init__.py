"""What the Solver trains on."""

from proposer_rl.curricula.alp_gmm import MixtureCurriculum
from proposer_rl.curricula.base import Advance, Curriculum, Improvement, Proposal
from proposer_rl.curricula.choice import Choice
from proposer_rl.curricula.currot import TransportCurriculum
from proposer_rl.curricula.first_order import (
    FirstOrderCurriculum,
    SampledFirstOrderCurriculum,
    require_gradients,
)
from proposer_rl.curricula.first_order_proposer import FirstOrderProposer
from proposer_rl.curricula.learning_progress import LearningProgressCurriculum
from proposer_rl.curricula.paired import PairedProposer
from proposer_rl.curricula.problem_proposer import ProblemProposer
from proposer_rl.curricula.proposer import ProposerCurriculum, ProposerTrainer
from proposer_rl.curricula.replay import ReplayCurriculum
from proposer_rl.curricula.sampling import SamplingCurriculum
from proposer_rl.curricula.schedule import ScheduleCurriculum
from proposer_rl.curricula.scores import Scorer
from proposer_rl.curricula.selection import SelectionCurriculum

__all__ = [
    "Advance",
    "Choice",
    "Curriculum",
    "FirstOrderCurriculum",
    "FirstOrderProposer",
    "Improvement",
    "LearningProgressCurriculum",
    "MixtureCurriculum",
    "PairedProposer",
    "ProblemProposer",
    "Proposal",
    "ProposerCurriculum",
    "ProposerTrainer",
    "ReplayCurriculum",
    "SampledFirstOrderCurriculum",
    "SamplingCurriculum",
    "ScheduleCurriculum",
    "Scorer",
    "SelectionCurriculum",
    "TransportCurriculum",
    "require_gradients",
]
