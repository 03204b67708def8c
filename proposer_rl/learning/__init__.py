"""PPO of one agent, or of K replicas of it at once."""

from proposer_rl.learning.advantages import LeaveOneOutBaseline as LeaveOneOutBaseline
from proposer_rl.learning.divergence import DivergedError as DivergedError
from proposer_rl.learning.divergence import located as located
from proposer_rl.learning.losses import MakeLoss as MakeLoss
from proposer_rl.learning.ppo import PPO as PPO
from proposer_rl.learning.ppo import Update as Update
from proposer_rl.learning.rollout import RolloutPolicy as RolloutPolicy
from proposer_rl.learning.rollout import first_episode_return as first_episode_return
from proposer_rl.learning.rollout import first_episode_success as first_episode_success
from proposer_rl.learning.rollout import in_first_episode as in_first_episode
from proposer_rl.learning.rollout import succeeded as succeeded
from proposer_rl.learning.snapshot import agent_weights as agent_weights
from proposer_rl.learning.snapshot import load_agent as load_agent
