"""A trap before the goal."""

from __future__ import annotations

import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.planes import LureEnv
from tests.tasks.arena.first_ends import levels, played

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
