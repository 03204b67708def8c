"""What the Solver trains on."""

from proposer_rl.curricula.base import Advance, Curriculum, Improvement, Proposal
from proposer_rl.curricula.proposer import ProposerCurriculum, ProposerTrainer
from proposer_rl.curricula.sampling import SamplingCurriculum
from proposer_rl.curricula.schedule import ScheduleCurriculum

__all__ = [
    "Advance",
    "Curriculum",
    "Improvement",
    "Proposal",
    "ProposerCurriculum",
    "ProposerTrainer",
    "SamplingCurriculum",
    "ScheduleCurriculum",
]
