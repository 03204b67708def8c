"""A crossing through a crowd, against a simulation in plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.ways import CrowdEnv
from proposer_rl.tasks.batched_envs.env import uniform
from tests.tasks.arena.first_ends import levels, played


def forward(state: dict) -> torch.Tensor:
    return torch.ones(len(state), dtype=torch.long)


def around(x: float) -> float:
    return (x + 1) % 2 - 1


def simulated(seed: int, pace: float, speed: float, size: float, steps: int) -> tuple[bool, int]:
    """Whether somebody who walks straight on gets across, and the step that it ends with."""

    def chance(step: int) -> list[float]:
        return uniform(torch.tensor([seed]), torch.tensor([step]), 4).tolist()

    others, y = [2 * share - 1 for share in chance(0)], 0.0
    for step in range(1, steps + 1):
        y += pace
        for lane, share in enumerate(chance(step)):
            others[lane] = around(others[lane] + (-1) ** lane * 2 * share * speed)
            if abs(others[lane]) < size and abs((lane + 1) / 5 - y) < 0.05:
                return False, step
        if y >= 1:
            return True, step
    return False, steps


def test_episodes_are_those_of_the_simulation() -> None:
    level = {"pace": 0.071, "speed": 0.1, "size": 0.25}
    result = played(CrowdEnv, levels(60, **level), 30, forward)
    wanted = [simulated(seed, **level, steps=30) for seed in range(60)]
    assert result["success"].tolist() == [success for success, _ in wanted]
    assert result["steps"].tolist() == [steps for _, steps in wanted]
    assert 0 < sum(success for success, _ in wanted) < 60


@pytest.mark.parametrize(("pace", "share"), [(0.033, 0.0), (0.034, 1.0)])
def test_who_is_too_slow_cannot_get_across(pace: float, share: float) -> None:
    result = played(CrowdEnv, levels(8, pace=pace, speed=0.1, size=0.0), 30, forward)
    assert float(result["success"].float().mean()) == share
    assert pace < 1 / 30 or math.isclose(float(result["steps"].float().mean()), 30)


def test_whoever_looks_gets_across_more_often() -> None:
    def careful(state: dict) -> torch.Tensor:
        y, others = state["state"][..., :1], state["state"][..., 1:]
        beside = others.abs() < 0.25 + 0.2
        lanes = torch.arange(1, 5) / 5
        ahead = (lanes - y - 0.08).abs() < 0.05
        return (~(beside & ahead).any(-1)).long()

    level = levels(400, pace=0.08, speed=0.1, size=0.25)
    careless, cautious = (
        float(played(CrowdEnv, level, 30, act)["success"].float().mean())
        for act in (forward, careful)
    )
    assert cautious > careless + 0.1
    check_env_specs(CrowdEnv(level[:3]), break_when_any_done="both")
