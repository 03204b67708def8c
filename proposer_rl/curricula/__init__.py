"""What the Solver trains on."""

from proposer_rl.curricula.base import Advance, Curriculum, Improvement
from proposer_rl.curricula.frozen_proposer import FrozenProposer, load_agent
from proposer_rl.curricula.proposer import ProposerCurriculum, total_gain
from proposer_rl.curricula.sampling import SamplingCurriculum, ScheduleCurriculum

__all__ = [
    "Advance",
    "Curriculum",
    "FrozenProposer",
    "Improvement",
    "ProposerCurriculum",
    "SamplingCurriculum",
    "ScheduleCurriculum",
    "load_agent",
    "total_gain",
]
