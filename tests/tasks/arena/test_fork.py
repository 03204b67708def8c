"""Corridors whose deep ends lie on the other side."""

from __future__ import annotations

import torch

from proposer_rl.tasks.arena.ways import ForkEnv
from tests.tasks.arena.episodes import levels, play

BOTH = levels(depth=[0.1, 0.96, 0.98, 1.0], length=[6, 2, 6, 2])


def test_going_right_is_right_on_all_levels_but_the_deep() -> None:
    env = ForkEnv(BOTH, max_steps=24)
    returns, success = play(env, lambda _: torch.ones(4, dtype=torch.int64))
    assert success.tolist() == [True, True, False, False]
    assert returns.tolist() == [1, 1, 0, 0]
    assert play(env, lambda _: torch.zeros(4, dtype=torch.int64))[1].equal(~success)


def test_an_episode_ends_where_a_walk_by_hand_does() -> None:
    env = ForkEnv(BOTH, max_steps=24)
    walk = [0, 1, 1, 1, 0, 1, 1, 1, 1, 1]  # visits -1 and then 2
    place, ends = 0, [0] * 4
    for step, action in enumerate(walk, 1):
        place += 2 * action - 1
        for i, (length, side) in enumerate([(6, 1), (2, 1), (6, -1), (2, -1)]):
            ends[i] = ends[i] or (step if side * place >= length or side * place <= -2 else 0)
    now, seen = env.reset(), [0] * 4
    for step, action in enumerate(walk, 1):
        now = env.step(now.set("action", torch.full((4,), action)))["next"]
        for i, done in enumerate(now["done"].squeeze(-1).tolist()):
            seen[i] = seen[i] or (step if done else 0)
    assert seen == ends
