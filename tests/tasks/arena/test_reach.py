"""Goals in the plane, whose middle a scripted push must reach."""

from __future__ import annotations

import math

import pytest
import torch

from proposer_rl.tasks.arena.planes import ReachEnv
from tests.tasks.arena.episodes import levels, play

CORNERS = levels(distance=[0.5, 4.0, 4.0, 4.0], direction=[-1.0, -0.4, 0.3, 1.0])


def test_a_push_towards_the_goal_reaches_the_farthest_and_its_opposite_none() -> None:
    env = ReachEnv(CORNERS, max_steps=40)
    away = lambda now: now["observation"][..., 2:4] * 4  # noqa: E731
    assert play(env, away)[1].all()
    returns, success = play(env, lambda now: -away(now))
    assert not success.any() and (returns < 0).all()


def test_an_episode_is_that_of_plain_numbers() -> None:
    x = y = u = v = total = 0.0
    a, b = 0.9, 0.4
    goal = 2.0 * math.cos(0.15 * math.pi), 2.0 * math.sin(0.15 * math.pi)
    for _ in range(40):
        u, v = 0.8 * u + 0.03 * a, 0.8 * v + 0.03 * b
        x, y = x + u, y + v
        there = math.hypot(goal[0] - x, goal[1] - y) <= 0.3
        total += there - 0.002 * (a * a + b * b)
        if there:
            break
    env = ReachEnv(levels(distance=[2.0], direction=[0.15]), max_steps=40)
    returns, success = play(env, lambda _: torch.tensor([[a, b]]))
    assert there and bool(success)
    assert float(returns) == pytest.approx(total, abs=1e-5)
