"""proposer_rl: learn to propose the problems that make a TorchRL agent improve fastest."""

from proposer_rl.curricula import (
    Curriculum,
    FrozenProposer,
    ProposerCurriculum,
    SamplingCurriculum,
    ScheduleCurriculum,
)
from proposer_rl.experiment import Experiment, Schedule
from proposer_rl.learning.advantages import CopiesBaseline
from proposer_rl.learning.ppo import PPO, PPOSettings
from proposer_rl.mazes import Level, LevelSpec, MazeEnv, generate_levels, shortest_path_length
from proposer_rl.mazes.evaluation import ExactEvaluator, RolloutEvaluator
from proposer_rl.mazes.task import MazeTask
from proposer_rl.meta.actions import Mixture, ProblemChoices, Proposals
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.rewards import performance_gain, task_difficulty
from proposer_rl.meta.view import SolverView
from proposer_rl.models import (
    ActorCritic,
    MapEncoder,
    MixtureHead,
    Population,
    ProblemHead,
    ProposerNetwork,
    UNet,
)
from proposer_rl.streams import Streams

__all__ = [
    "PPO",
    "ActorCritic",
    "CopiesBaseline",
    "Curriculum",
    "ExactEvaluator",
    "Experiment",
    "FrozenProposer",
    "Level",
    "LevelSpec",
    "MapEncoder",
    "MazeEnv",
    "MazeTask",
    "Mixture",
    "MixtureHead",
    "PPOSettings",
    "Population",
    "ProblemChoices",
    "ProblemHead",
    "Proposals",
    "ProposerCurriculum",
    "ProposerNetwork",
    "RolloutEvaluator",
    "SamplingCurriculum",
    "Schedule",
    "ScheduleCurriculum",
    "SolverTrainingEnv",
    "SolverView",
    "Streams",
    "UNet",
    "generate_levels",
    "performance_gain",
    "shortest_path_length",
    "task_difficulty",
]
