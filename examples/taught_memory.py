"""Train your own LSTM agent with ACCEL, which edits replayed mazes.

python examples/taught_memory.py [updates]
"""

from __future__ import annotations

import sys
from typing import Any

import torch
from torch import Tensor, nn

import proposer_rl as prl
from proposer_rl.tasks.mazes.generation import edit_levels
from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv
from proposer_rl.tasks.view_mazes.view_levels import scattered_walls

MAZES, STEPS = 32, 24


def main(updates: int = 200) -> None:
    """Train; print returns, and the number of edits of the mazes in the buffer."""
    torch.manual_seed(0)
    fresh = lambda n, g: scattered_walls(torch.zeros(n).long(), 7, 7, g)  # noqa: E731
    env = ViewMazeEnv(fresh(MAZES, torch.Generator()), max_steps=STEPS)
    memory, heads = nn.LSTMCell(29, 32), nn.Linear(32, 3 + 1)  # three actions and a value

    def play(levels: Any) -> tuple[Tensor, Tensor, Tensor]:
        env.set_levels(levels)
        state, hidden, alive, told = env.reset(), None, torch.ones(len(levels)), []
        for _ in range(STEPS):
            seen = state["view"].flatten(1) / 8, nn.functional.one_hot(state["direction"], 4)
            hidden = memory(torch.cat(seen, 1), hidden)
            out = heads(hidden[0])
            policy = torch.distributions.Categorical(logits=out[:, :3])
            log_prob = policy.log_prob(state.set("action", policy.sample())["action"])
            state = env.step(state)["next"]
            told.append([x * alive for x in (log_prob, out[:, 3], state["reward"].squeeze(1))])
            alive = alive * ~state["done"].squeeze(1)
        return tuple(map(torch.stack, zip(*told, strict=True)))

    edit = lambda levels, count, g: edit_levels(levels.unsqueeze(0), count, [g])[0]  # noqa: E731
    aside = lambda levels, g: {"return": play(levels)[2].sum(0).detach()}  # noqa: E731
    accel = prl.curricula.accel(score="max_mc", capacity=256, new_levels=None)
    teacher = prl.Teacher(accel, prl.LevelGenerator(fresh, edit=edit), play=aside, batch_size=MAZES)
    optimiser = torch.optim.Adam([*memory.parameters(), *heads.parameters()], 3e-3)
    for update in range(updates):
        log_prob, value, reward = play(teacher.propose(MAZES))
        advantage = reward.flip(0).cumsum(0).flip(0) - value
        loss = advantage.square().mean() - (advantage.detach() * log_prob).mean()
        optimiser.zero_grad(), loss.backward(), optimiser.step()
        teacher.observe({"return": reward.sum(0), "score": advantage.detach().abs().mean(0)})
        if update % 20 == 19:
            edits = 5 * teacher.log()["mean_generation"]
            print(f"{update}: return {reward.sum(0).mean():.2f}, {edits:.1f} edits of a maze")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
