"""proposer_rl: learn to propose the problems that make a TorchRL agent improve fastest."""

from proposer_rl.curricula import (
    Curriculum,
    ProposerCurriculum,
    SamplingCurriculum,
    ScheduleCurriculum,
)
from proposer_rl.evaluation import ExactEvaluator, RolloutEvaluator
from proposer_rl.experiment import Experiment, Schedule
from proposer_rl.mazes import Level, LevelSpec, MazeEnv, generate_levels, shortest_path_length
from proposer_rl.meta_env import SolverTrainingEnv
from proposer_rl.models import ActorCritic, Population, ProposerNetwork, UNet
from proposer_rl.ppo import PPO, PPOSettings
from proposer_rl.rewards import performance_gain, task_difficulty
from proposer_rl.streams import Streams
from proposer_rl.task import MazeTask

__all__ = [
    "PPO",
    "ActorCritic",
    "Curriculum",
    "ExactEvaluator",
    "Experiment",
    "Level",
    "LevelSpec",
    "MazeEnv",
    "MazeTask",
    "PPOSettings",
    "Population",
    "ProposerCurriculum",
    "ProposerNetwork",
    "RolloutEvaluator",
    "SamplingCurriculum",
    "Schedule",
    "ScheduleCurriculum",
    "SolverTrainingEnv",
    "Streams",
    "UNet",
    "generate_levels",
    "performance_gain",
    "shortest_path_length",
    "task_difficulty",
]
