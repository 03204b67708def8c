"""Points in the plane: who gets to a goal, and who is held up by walls."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import check_env_specs

from proposer_rl.cli.build import make_task
from proposer_rl.streams import Streams
from proposer_rl.tasks.arena.planes import GoalMazeEnv, LureEnv, ReachEnv
from tests.tasks.arena.episodes import levels, play, played
from tests.tiny import composed

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


def test_about_half_of_the_target_is_possible_and_the_far_end_is_not() -> None:
    task = make_task(composed("task=arena/half", "+method=target"))
    drawn = task.target.sample(600, Streams(0).generator())
    env = task.environment(drawn)

    def push(now: TensorDictBase) -> torch.Tensor:
        apart = now["observation"][..., 2:4]
        return apart / apart.abs().amax(-1, keepdim=True)

    _, success = play(env, push)
    assert 0.4 < float(success.float().mean()) < 0.55
    speed = place = 0.0
    for _ in range(25):
        speed = 0.8 * speed + 0.03
        place += speed
    goals = drawn["distance"] * (torch.pi * drawn["direction"]).cos()  # along the fastest axis
    assert not success[goals > place + 0.3].any()
    assert success[drawn["distance"] < place + 0.2].all()


TRAP = {"depth": 1.2, "distance": 4.0, "width": 1.2}


def greedy(state: dict) -> torch.Tensor:
    return (torch.tensor([4.0, 0.0]) - state["state"]) / 0.2


def around(state: dict) -> torch.Tensor:
    """Up before the trap, along it, and down to the goal behind it."""
    x, y = state["state"].unbind(-1)
    up = torch.where(x < 2.1, ((0.8 - y) / 0.2), -y / 0.2)
    ready = ((y > 0.7) | (x >= 2.1)).float()
    return torch.stack([ready * (4 - x) / 0.2, up], -1)


def test_the_straight_way_ends_in_the_trap_and_the_one_around_it_at_the_goal() -> None:
    stuck = played(LureEnv, levels(8, **TRAP), 60, greedy)
    assert not stuck["success"].any() and (stuck["places"][:, -1, 0] < 2).all()
    assert (stuck["return"] > 1.5).all()  # what lures
    result = played(LureEnv, levels(8, **TRAP), 60, around)
    assert result["success"].all() and (result["return"] > stuck["return"] + 2).all()


def test_without_a_wall_the_straight_way_is_the_best() -> None:
    assert played(LureEnv, levels(8, **TRAP | {"width": 0.0}), 60, greedy)["success"].all()


def test_nothing_gets_through_the_walls() -> None:
    """Whoever comes from below into the trap's span of x from outside stays outside."""
    torch.manual_seed(0)
    places = played(LureEnv, levels(64, **TRAP), 60, lambda _: 2 * torch.rand(64, 2) - 0.8)[
        "places"
    ]
    inside = ((places[..., 0] > 0.8) & (places[..., 0] < 2) & (places[..., 1].abs() < 0.6)).float()
    entered, left = inside.diff(dim=1) > 0, inside.diff(dim=1) < 0
    assert (places[:, :-1, 0][entered] <= 0.8).all()
    assert (places[:, 1:, 0][left] <= 0.8).all() and left.any()
    check_env_specs(LureEnv(levels(3, **TRAP)), break_when_any_done="both")


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
