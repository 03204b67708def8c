"""PPO for one agent, or for K independent replicas of it at once."""

from proposer_rl.learning.episodes import first_episode_return as first_episode_return
from proposer_rl.learning.episodes import first_episode_success as first_episode_success
from proposer_rl.learning.episodes import in_first_episode as in_first_episode
from proposer_rl.learning.episodes import mean_performance as mean_performance
from proposer_rl.learning.episodes import play_episodes as play_episodes
from proposer_rl.learning.episodes import succeeded as succeeded
from proposer_rl.learning.objective import DivergedError as DivergedError
from proposer_rl.learning.objective import LearningSettings as LearningSettings
from proposer_rl.learning.objective import LeaveOneOutBaseline as LeaveOneOutBaseline
from proposer_rl.learning.objective import MakeLoss as MakeLoss
from proposer_rl.learning.objective import PPOSettings as PPOSettings
from proposer_rl.learning.objective import SolverSettings as SolverSettings
from proposer_rl.learning.objective import gae as gae
from proposer_rl.learning.objective import located as located
from proposer_rl.learning.ppo import PPO as PPO
from proposer_rl.learning.ppo import Replica as Replica
from proposer_rl.learning.ppo import Update as Update
from proposer_rl.learning.ppo import agent_values as agent_values
from proposer_rl.learning.ppo import agent_weights as agent_weights
from proposer_rl.learning.ppo import load_agent as load_agent
from proposer_rl.learning.rollout import RolloutCollector as RolloutCollector
from proposer_rl.learning.rollout import RolloutPolicy as RolloutPolicy
