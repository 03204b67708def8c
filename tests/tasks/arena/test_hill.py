"""The mountain car against Gymnasium's, and which engines climb."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.control import HillEnv


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
