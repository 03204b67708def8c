"""proposer_rl: learn to propose the problems that make a TorchRL agent improve fastest."""

from proposer_rl.advantages import CopiesBaseline
from proposer_rl.curricula import (
    Curriculum,
    FrozenProposer,
    ProposerCurriculum,
    SamplingCurriculum,
    ScheduleCurriculum,
)
from proposer_rl.evaluation import ExactEvaluator, RolloutEvaluator
from proposer_rl.experiment import Experiment, Schedule
from proposer_rl.mazes import Level, LevelSpec, MazeEnv, generate_levels, shortest_path_length
from proposer_rl.meta_env import SolverTrainingEnv
from proposer_rl.models import (
    ActorCritic,
    MapEncoder,
    MixtureHead,
    Population,
    ProblemHead,
    ProposerNetwork,
    UNet,
)
from proposer_rl.ppo import PPO, PPOSettings
from proposer_rl.proposals import Mixture, ProblemChoices, Proposals
from proposer_rl.rewards import performance_gain, task_difficulty
from proposer_rl.solver_view import SolverView
from proposer_rl.streams import Streams
from proposer_rl.task import MazeTask

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
