"""The names of ``proposer_rl`` itself."""

from proposer_rl.curricula import (
    Batch,
    Curriculum,
    ProposerCurriculum,
    ProposerTrainer,
    SamplingCurriculum,
)
from proposer_rl.experiment import Experiment
from proposer_rl.learning import PPO, LeaveOneOutBaseline
from proposer_rl.meta.actions import Mixture, ProblemChoices
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.rewards import log_success_gain, performance_gain, task_difficulty
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
from proposer_rl.settings import PPOSettings, Schedule, SolverSettings
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task
from proposer_rl.tasks.mazes import Level, LevelSpec, MazeEnv, generate_levels, shortest_path_length
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator, RolloutEvaluator

__all__ = [
    "PPO",
    "ActorCritic",
    "Batch",
    "ComputeContext",
    "Curriculum",
    "ExactEvaluator",
    "Experiment",
    "LeaveOneOutBaseline",
    "Level",
    "LevelSpec",
    "MapEncoder",
    "MazeEnv",
    "Mixture",
    "MixtureHead",
    "PPOSettings",
    "Population",
    "ProblemChoices",
    "ProblemHead",
    "ProposerCurriculum",
    "ProposerNetwork",
    "ProposerTrainer",
    "RolloutEvaluator",
    "SamplingCurriculum",
    "Schedule",
    "SolverSettings",
    "SolverTrainingEnv",
    "SolverView",
    "Streams",
    "Task",
    "UNet",
    "generate_levels",
    "log_success_gain",
    "performance_gain",
    "shortest_path_length",
    "task_difficulty",
]
