"""Use a curriculum in TorchRL's PPO loop: two places, marked "teacher", replay gravities.

python examples/taught_torchrl.py [iterations]
"""

from __future__ import annotations

import sys
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import proposer_rl as prl


def set_gravity(env: Any, level: Any) -> None:
    """Set a level in the environment (teacher)."""
    env.unwrapped.gravity = float(level["gravity"])


def main(iterations: int = 40) -> None:
    """Train; print the mean length of episodes."""
    torch.manual_seed(0)
    teacher = prl.Teacher(prl.curricula.plr(capacity=200), prl.Parameters({"gravity": (5.0, 25.0)}))
    env = TransformedEnv(  # teacher
        GymEnv("CartPole-v1", categorical_action_encoding=True),
        prl.LevelTransform(teacher, set_gravity),
    )
    actor = ProbabilisticActor(
        TensorDictModule(MLP(4, 2, num_cells=[64, 64]), ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(4, 1, num_cells=[64, 64]), ["observation"])
    collector = Collector(env, actor, frames_per_batch=256, total_frames=256 * iterations)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic, normalize_advantage=True)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    for iteration, batch in enumerate(collector):
        for _ in range(4):
            advantage(batch)
            terms = loss(batch)
            optimiser.zero_grad()
            sum(terms[k] for k in terms.keys() if k.startswith("loss_")).backward()
            optimiser.step()
        episodes = max(int(batch["next", "done"].sum()), 1)
        print(f"{iteration}: steps of an episode {len(batch) / episodes:.0f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
