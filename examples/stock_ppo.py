"""Train on mazes by an ordinary TorchRL script: Collector, GAE and ClipPPOLoss.

The environment draws the agent on a plane of its observation, so that any network for images can be
used. New levels are set before every batch.

    python examples/stock_ppo.py [iterations]
"""

from __future__ import annotations

import sys

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.modules import MLP, ConvNet, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from proposer_rl.tasks.mazes import Level, MazeEnv, generate_levels

MAZES, STEPS, EPOCHS, MINIBATCH = 64, 20, 4, 320


def levels() -> Level:
    """Draw 5x5 mazes with 5 obstacles and a shortest path of 4 moves."""
    return generate_levels([0.2] * MAZES, 4, height=5, width=5)


def network(outputs: int) -> nn.Module:
    """Make a network from planes [*B, 4, 5, 5] to numbers [*B, outputs]."""
    convolutions = ConvNet(
        4, num_cells=[16, 32], kernel_sizes=3, paddings=1, activation_class=nn.ReLU
    )
    return nn.Sequential(convolutions, MLP(32 * 25, outputs, num_cells=[64]))


def main(iterations: int = 60) -> None:
    """Train with PPO; print the share of first episodes that reach the goal."""
    torch.manual_seed(0)
    env = MazeEnv(levels(), max_steps=STEPS, observe_agent=True)
    actor = ProbabilisticActor(
        TensorDictModule(network(4), ["planes"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    critic = ValueOperator(network(1), ["planes"])
    collector = Collector(
        env,
        actor,
        frames_per_batch=MAZES * STEPS,
        total_frames=-1,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(
        actor, critic, entropy_coeff=0.01, critic_coeff=0.5, normalize_advantage=True
    )
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(MAZES * STEPS),
        sampler=SamplerWithoutReplacement(),
        batch_size=MINIBATCH,
    )
    for iteration in range(iterations):
        env.set_levels(levels())
        batch = collector.rollout()  # [MAZES, STEPS]
        reached = batch["next", "terminated"].any(1).float().mean()
        if iteration % 10 == 0 or iteration == iterations - 1:
            print(f"iteration {iteration:3d}: success {reached:.3f}")
        with torch.no_grad():
            advantage(batch)
        buffer.extend(batch.reshape(-1))
        for _ in range(EPOCHS):
            for minibatch in buffer:
                terms = loss(minibatch)
                total = terms["loss_objective"] + terms["loss_entropy"] + terms["loss_critic"]
                optimiser.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimiser.step()
    collector.shutdown()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
