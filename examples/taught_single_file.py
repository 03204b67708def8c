"""Use a curriculum in a single-file script like CleanRL's, with vector environments.

python examples/taught_single_file.py [iterations]
"""

from __future__ import annotations

import sys

import gymnasium
import torch
from torch import nn

import proposer_rl as prl

ENVS, STEPS, GAMMA = 8, 64, 0.99


def main(iterations: int = 60) -> None:
    """Train with a policy gradient and a critic; print the length of episodes."""
    torch.manual_seed(0)
    space = prl.Parameters({"gravity": (5.0, 25.0), "force_mag": [5.0, 10.0, 15.0]})
    teacher = prl.Teacher(prl.curricula.alp_gmm(warmup=64, refit=64), space)
    sets = {"gravity": "gravity", "force_mag": "force_mag"}
    envs = gymnasium.vector.SyncVectorEnv(
        [lambda: prl.TaughtEnv(gymnasium.make("CartPole-v1"), teacher, sets)] * ENVS,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    actor = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 2))
    critic = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 1))
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], 3e-3)
    seen = torch.as_tensor(envs.reset(seed=0)[0])
    lengths = []
    for _ in range(iterations):
        log_probs, values, rewards, dones = [], [], [], []
        for _ in range(STEPS):
            policy = torch.distributions.Categorical(logits=actor(seen))
            action = policy.sample()
            values.append(critic(seen).squeeze(-1))
            log_probs.append(policy.log_prob(action))
            observation, reward, terminated, truncated, _ = envs.step(action.numpy())
            seen = torch.as_tensor(observation)
            rewards.append(torch.as_tensor(reward).float())
            dones.append(torch.as_tensor(terminated | truncated).float())
        value, target = critic(seen).squeeze(-1).detach(), []
        for reward, done in zip(reversed(rewards), reversed(dones), strict=True):
            value = reward + GAMMA * value * (1 - done)
            target.insert(0, value)
        advantage = torch.stack(target) - torch.stack(values)
        loss = advantage.square().mean() - (advantage.detach() * torch.stack(log_probs)).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        lengths.append(float(ENVS * STEPS / torch.stack(dones).sum().clamp(1)))
    print(f"steps of an episode: {lengths[0]:.0f} at first, {lengths[-1]:.0f} at last")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
