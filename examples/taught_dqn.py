"""Use a curriculum with DQN: one level for each episode, and a replay buffer of transitions.

python examples/taught_dqn.py [episodes]
"""

from __future__ import annotations

import random
import sys
from collections import deque

import gymnasium
import torch
from torch import nn

import proposer_rl as prl


def main(episodes: int = 200) -> None:
    """Train on gravities chosen by prioritised replay; print every twentieth return."""
    torch.manual_seed(0)
    random.seed(0)
    env = gymnasium.make("CartPole-v1")
    space = prl.Parameters({"gravity": (5.0, 25.0)})
    teacher = prl.Teacher(prl.curricula.plr(capacity=64, fill=0.25), space)
    network, old = (nn.Sequential(nn.Linear(4, 64), nn.ReLU(), nn.Linear(64, 2)) for _ in range(2))
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    memory: deque = deque(maxlen=20_000)
    for episode in range(episodes):
        ticket, level = teacher.ask()
        env.unwrapped.gravity = level["gravity"]
        seen, total, over = torch.as_tensor(env.reset(seed=episode)[0]), 0.0, False
        while not over:
            greedy = random.random() > max(0.05, 1 - episode / 100)
            action = int(network(seen).argmax()) if greedy else env.action_space.sample()
            after, reward, terminated, truncated, _ = env.step(action)
            after, over, total = torch.as_tensor(after), terminated or truncated, total + reward
            memory.append((seen, torch.tensor(action), after, torch.tensor(float(terminated))))
            seen = after
            if len(memory) >= 64 and len(memory) % 2 == 0:
                s, a, t, end = map(torch.stack, zip(*random.sample(memory, 64), strict=True))
                target = 1 + 0.99 * (1 - end) * old(t).amax(1).detach()
                loss = (network(s).gather(1, a[:, None]).squeeze(1) - target).square().mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
        teacher.tell(ticket, return_=total)
        if episode % 10 == 0:
            old.load_state_dict(network.state_dict())
        if episode % 20 == 0:
            print(f"episode {episode}: return {total:.0f} at gravity {level['gravity']:.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
