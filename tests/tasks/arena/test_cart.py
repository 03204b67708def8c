"""Cart and pole against Gymnasium's, and a controller."""

from __future__ import annotations

import gymnasium
import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.control import CartEnv
from tests.tasks.arena.first_ends import levels, played

USUAL = {
    **{"gravity": 9.8, "cart": 1.0, "pole": 0.1, "length": 0.5},
    **{"force": 10.0, "tau": 0.02, "friction": 0.0},
}


def test_steps_are_gymnasiums() -> None:
    env, other = CartEnv(levels(1, **USUAL)), gymnasium.make("CartPole-v1").unwrapped
    other.reset(seed=0)
    state = env.reset()
    other.state = state["state"][0].double().numpy()
    for number in range(40):
        action = number % 3 > 0
        state = env.step(state.set("action", torch.tensor([int(action)])))["next"].exclude("reward")
        seen, _, lost, *_ = other.step(int(action))
        assert state["state"][0].tolist() == pytest.approx(seen.tolist(), abs=1e-4)
        assert bool(state["terminated"]) == lost
        if lost:
            return
    raise AssertionError("the pole never falls")


def balanced(state: dict) -> torch.Tensor:
    place, speed, angle, turning = state["state"].unbind(-1)
    return (0.03 * place + 0.1 * speed + angle + 0.3 * turning > 0).long()


def test_a_controller_survives_and_idle_numbers_change_nothing() -> None:
    result = played(CartEnv, levels(16, **USUAL), 80, balanced)
    assert result["success"].all() and (result["return"] == 80).all()
    idle = played(CartEnv, levels(16, **USUAL, colour=0.7, sound=0.1, scent=5.0), 80, balanced)
    assert (idle["places"] == result["places"]).all()


def test_friction_slows_a_cart_down() -> None:
    ways = [
        played(CartEnv, levels(1, **USUAL | {"friction": friction}), 8, lambda _: torch.ones(1))
        for friction in (0.0, 1.0)
    ]
    assert ways[0]["places"][0, -1, 0] > ways[1]["places"][0, -1, 0]
    check_env_specs(CartEnv(levels(3, **USUAL)), break_when_any_done="both")
