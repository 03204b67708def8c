"""Stable-Baselines3's PPO with rl-baselines3-zoo's numbers, for ``gymnasium`` to be set beside."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

# As hyperparams/ppo.yml of rl-baselines3-zoo has them, LunarLander's of its version 2. ``linear``
# names what falls to zero; batch_size is that of a minibatch.
NUMBERS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {
        "n_envs": 8,
        "n_steps": 32,
        "batch_size": 256,
        "gae_lambda": 0.8,
        "gamma": 0.98,
        "n_epochs": 20,
        "ent_coef": 0.0,
        "learning_rate": 1e-3,
        "clip_range": 0.2,
        "linear": ["learning_rate", "clip_range"],
    },
    "LunarLander-v3": {
        "n_envs": 16,
        "n_steps": 1024,
        "batch_size": 64,
        "gae_lambda": 0.98,
        "gamma": 0.999,
        "n_epochs": 4,
        "ent_coef": 0.01,
    },
    "BipedalWalker-v3": {
        "normalize": True,
        "n_envs": 32,
        "n_steps": 2048,
        "batch_size": 64,
        "gae_lambda": 0.95,
        "gamma": 0.999,
        "n_epochs": 10,
        "ent_coef": 0.0,
        "learning_rate": 3e-4,
        "clip_range": 0.18,
    },
}


def train_sb3(
    environment: str, seed: int, frames: int, episodes: int
) -> tuple[int, float, float, float]:
    """Train and evaluate once; what is drawn is a function of the seed.

    Args:
        environment: one of :data:`NUMBERS`.
        seed: of all random draws.
        frames: to train for, rounded up to whole rollouts.
        episodes: of the evaluation, with the most probable actions.

    Returns:
        Frames; seconds of the processors in training; the mean and the smallest undiscounted return
        of the episodes.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecNormalize

    numbers = dict(NUMBERS[environment])
    normalize = numbers.pop("normalize", False)
    for name in numbers.pop("linear", []):
        numbers[name] = _linear(numbers[name])
    env: Any = make_vec_env(environment, numbers.pop("n_envs"), seed=seed)
    unseen: Any = make_vec_env(environment, 8, seed=10_000 + seed)
    if normalize:
        env = VecNormalize(env, gamma=numbers["gamma"])
        unseen = VecNormalize(unseen, training=False, norm_reward=False)
    model = PPO("MlpPolicy", env, seed=seed, device="cpu", **numbers)
    started = time.process_time()
    model.learn(frames)
    cpu = time.process_time() - started
    if normalize:
        unseen.obs_rms = env.obs_rms
    returns, _ = evaluate_policy(model, unseen, episodes, return_episode_rewards=True, warn=False)
    return model.num_timesteps, cpu, float(np.mean(returns)), float(np.min(returns))


def _linear(initial: float) -> Callable[[float], float]:
    return lambda left: left * initial
