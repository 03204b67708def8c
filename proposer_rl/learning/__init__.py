"""PPO of one agent, or of K replicas of it at once."""

from proposer_rl.learning.advantages import LeaveOneOutBaseline
from proposer_rl.learning.divergence import DivergedError, located
from proposer_rl.learning.losses import MakeLoss
from proposer_rl.learning.ppo import PPO, Update
from proposer_rl.learning.rollout import (
    RolloutPolicy,
    first_episode_return,
    first_episode_success,
    succeeded,
)
from proposer_rl.learning.snapshot import agent_weights, load_agent

__all__ = [
    "PPO",
    "DivergedError",
    "LeaveOneOutBaseline",
    "MakeLoss",
    "RolloutPolicy",
    "Update",
    "agent_weights",
    "first_episode_return",
    "first_episode_success",
    "load_agent",
    "located",
    "succeeded",
]
