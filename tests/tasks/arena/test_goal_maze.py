"""CurrOT's goals in a corridor around a block."""

from __future__ import annotations

import math

import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.planes import GoalMazeEnv
from tests.tasks.arena.first_ends import levels, played

WAY = [(-6.0, 6.0), (6.0, 6.0), (6.0, -6.0)]  # corners of the corridor, clockwise


def towards(place: torch.Tensor, to: torch.Tensor) -> torch.Tensor:
    return (to - place) / 0.3


def test_a_way_around_the_block_reaches_a_small_goal_on_the_other_side() -> None:
    level, passed = levels(16, x=6.0, y=-0.5, tolerance=0.05), torch.zeros(16, dtype=torch.long)
    corners = torch.tensor([*WAY[:2], (6.0, -0.5)])

    def act(state: dict) -> torch.Tensor:
        place = state["state"]
        passed[(corners[passed] - place).norm(dim=-1) < 0.01] += 1
        return towards(place, corners[passed.clamp_(max=2)])

    result = played(GoalMazeEnv, level, 200, act)
    assert result["success"].all() and (result["return"] == 1).all()
    ways = [math.dist((-6, 6), (-6, -6)) + 12 + 6.5] * 16
    assert (result["steps"] * 0.3 - torch.tensor(ways)).abs().max() < 2.5


def test_walls_hold_a_point_up_and_goals_in_them_are_out_of_reach() -> None:
    goal = torch.tensor([-3.0, -6.5])

    def straight(state: dict) -> torch.Tensor:
        return towards(state["state"], goal * torch.tensor([1.0, -1.0]))

    result = played(GoalMazeEnv, levels(8, x=0.0, y=0.0, tolerance=4.9), 60, straight)
    assert not result["success"].any()
    assert (result["places"].abs().amax(-1) >= 5).all()
    assert (
        played(GoalMazeEnv, levels(8, x=0.0, y=0.0, tolerance=18.0), 60, straight)["steps"].max()
        == 1
    )


def test_an_action_longer_than_one_is_a_stride_of_three_tenths() -> None:
    result = played(
        GoalMazeEnv, levels(4, x=9.0, y=9.0, tolerance=1.0), 3, lambda _: torch.ones(4, 2)
    )
    moved = result["places"][:, 2] - result["places"][:, 1]
    walked = moved.norm(dim=-1)[(result["places"][:, 2].abs() < 5 - 1e-6).sum(-1) == 0]
    assert walked.tolist() == pytest.approx([0.3] * len(walked), abs=1e-5)
    check_env_specs(GoalMazeEnv(levels(3, x=1.0, y=1.0, tolerance=1.0)), break_when_any_done="both")
