"""Use a curriculum with Stable-Baselines3: CartPole with many gravities, eight at a time.

python examples/taught_sb3.py [steps]
"""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import proposer_rl as prl
from proposer_rl.tasks.gymnasium.cartpole import set_length
from proposer_rl.teaching.sb3 import TeacherCallback

SPACE = prl.Parameters({"gravity": (5.0, 25.0), "length": (0.3, 1.0)})


def set_level(env: Any, level: Any) -> None:
    """Set a level; ``set_length`` also sets the numbers that CartPole derives from the length."""
    env.gravity = level["gravity"]
    set_length(env, level["length"])


def main(steps: int = 20_000) -> PPO:
    """Train; the log has the teacher's numbers as ``teacher/NAME``."""
    teacher = prl.Teacher(prl.curricula.learning_progress(source="episodes"), SPACE)

    def make() -> gymnasium.Env:
        env = prl.TaughtEnv(
            gymnasium.make("CartPole-v1"),
            teacher,
            set_level,
            success="truncated",  # the pole stood until the time limit
        )
        return Monitor(env)

    model = PPO("MlpPolicy", DummyVecEnv([make] * 8), n_steps=64, verbose=1, device="cpu", seed=0)
    return model.learn(steps, callback=TeacherCallback(teacher))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
