"""Pendulums, against a simulation in plain numbers."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDictBase

from proposer_rl.tasks.arena.control import SwingEnv
from tests.tasks.arena.episodes import levels, play

EASY = {"mass": [1.0], "length": [1.0], "torque": [8.0], "seed": [3]}


def test_an_episode_is_that_of_plain_numbers() -> None:
    env = SwingEnv(levels(mass=[0.8], length=[1.2], torque=[3.0], seed=[3]), max_steps=70)
    angle, speed, total = float(env.reset()["state"][0, 0]), 0.0, 0.0
    for _ in range(70):
        spin = 15 / 1.2 * math.sin(angle) + 3 * 0.4 * 3.0 / (0.8 * 1.2**2)
        speed = min(max(speed + 0.06 * spin, -8), 8)
        angle += 0.06 * speed
        total += 0.01 * (1 + math.cos(angle)) - 0.0001 * speed**2
    returns, _ = play(env, lambda _: torch.full((1, 1), 0.4))
    assert float(returns) == pytest.approx(total, abs=1e-3)


def test_a_strong_engine_lifts_by_feedback_and_rest_is_no_success() -> None:
    env = SwingEnv(levels(**EASY), max_steps=70)

    def lift(now: TensorDictBase) -> torch.Tensor:
        angle, speed, _ = now["state"].unbind(-1)
        off = torch.atan2(angle.sin(), angle.cos())
        return (-(2 * off + 0.3 * speed)).unsqueeze(-1)

    assert bool(play(env, lift)[1])
    assert not bool(play(env, lambda _: torch.zeros(1, 1))[1])
