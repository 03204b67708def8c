"""Cart and pole, mountain car and pendulum against Gymnasium's and plain numbers."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.control import CartEnv, HillEnv, SwingEnv
from tests.tasks.arena.episodes import levels, play, played

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


def cars(*forces: float) -> TensorDict:
    level = {"force": torch.tensor(forces), "seed": torch.arange(len(forces))}
    return TensorDict(level, [len(forces)])


@pytest.mark.parametrize("force", [0.001, 0.003])
def test_steps_are_those_of_gymnasium(force: float) -> None:
    """From where ours begins, with the engine's strength as Gymnasium's attribute."""
    inner = gymnasium.make("MountainCar-v0").unwrapped
    inner.force = force
    env, limit = HillEnv(cars(force), max_steps=150), 150
    state, draws = env.reset(), np.random.default_rng(0)
    place, speed = state["state"][0].tolist()
    assert -0.6 <= place <= -0.4 and speed == 0
    inner.reset()
    inner.state = (place, speed)
    for _ in range(limit):
        swing = 2 if speed >= 0 else 0  # which gets up in the end
        action = swing if draws.random() < 0.8 else int(draws.integers(3))
        (place, speed), _, terminated, *_ = inner.step(action)
        state = env.step(state.set("action", torch.tensor([action])))["next"]
        ours = state["state"][0].tolist()
        assert ours == pytest.approx([place, speed], abs=1e-4)
        assert bool(state["terminated"]) == bool(state["success"]) == terminated
        assert float(state["reward"]) == terminated
        if terminated:
            break
        state = state.exclude("reward")
    assert terminated


def test_the_engine_is_what_differs() -> None:
    """Straight ahead only a strong one gets up; the target's has to swing, and has the time."""
    env = HillEnv(cars(0.0045, 0.0045, 0.001, 0.001), max_steps=150)
    state, up = env.reset(), torch.zeros(4, dtype=torch.bool)
    for _ in range(150):
        swing = 2 * (state["state"][:, 1] >= 0)
        action = torch.where(torch.tensor([True, False, True, False]), 2, swing)
        after = env.step(state.set("action", action))["next"]
        up |= after["success"].squeeze(-1)
        state = after.exclude("reward")
    assert up.tolist() == [True, True, False, True]


def test_torchrl_finds_nothing_wrong_and_all_is_scaled() -> None:
    env = HillEnv(cars(0.0005, 0.0045), max_steps=6)
    check_env_specs(env, break_when_any_done="both")
    played = env.rollout(40, break_when_any_done=False)["observation"]
    assert played.abs().max() <= 1
    assert played[:, 0, 0].abs().max() <= 0.3 and played[:, 0, 2].tolist() == pytest.approx(
        [-5 / 6, 0.5]
    )


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
