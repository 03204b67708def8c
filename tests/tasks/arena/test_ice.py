"""Strips of ice: the share of successes is that of the Markov chain."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from proposer_rl.tasks.arena.ways import IceEnv
from tests.tasks.arena.episodes import levels, play

EPISODES, STEPS = 4000, 40


def chain(length: int, width: int, slip: float) -> float:
    """How often the end is reached by stepping back to the middle, and else ahead."""
    here = np.zeros((length + 1, width + 2))  # pits at both ends of a row
    here[0, width // 2 + 1] = 1
    for _ in range(STEPS):
        then = np.zeros_like(here)
        for x, y in np.ndindex(*here.shape):
            if x == length or y in (0, width + 1):
                then[x, y] += here[x, y]
                continue
            turn = np.sign(width // 2 + 1 - y)
            then[x + (turn == 0), y + turn] += (1 - slip) * here[x, y]
            then[x, y - 1] += slip / 2 * here[x, y]
            then[x, y + 1] += slip / 2 * here[x, y]
        here = then
    return float(here[length, 1:-1].sum())


@pytest.mark.parametrize(("length", "width", "slip"), [(14, 1, 0.0), (14, 3, 0.3), (6, 5, 0.4)])
def test_successes_are_as_frequent_as_the_chain_says(length: int, width: int, slip: float) -> None:
    same = {"length": length, "width": width, "slip": slip}
    many = {name: torch.full((EPISODES,), value) for name, value in same.items()}
    env = IceEnv(levels(seed=torch.arange(EPISODES), **many), max_steps=STEPS)

    def careful(now: TensorDictBase) -> torch.Tensor:
        left, right = now["observation"][..., 1], now["observation"][..., 2]
        return torch.where(left > right, 1, torch.where(left < right, 2, 0))

    returns, success = play(env, careful)
    assert float(success.float().mean()) == pytest.approx(chain(length, width, slip), abs=0.03)
    assert set(returns[~success].tolist()) <= {torch.tensor(-0.1).item(), 0.0}


def test_who_waits_runs_out_of_time_without_a_cost() -> None:
    env = IceEnv(levels(length=[4], width=[3], slip=[0.0], seed=[1]), max_steps=STEPS)
    assert [float(result) for result in play(env, lambda _: torch.tensor([3]))] == [0.0, 0.0]
