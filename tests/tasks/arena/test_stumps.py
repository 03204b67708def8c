"""Tracks of stumps, against a simulation in plain Python."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.planes import StumpsEnv
from proposer_rl.tasks.batched_envs import uniform
from tests.tasks.arena.episodes import levels, played

STEPS = 80


def simulated(
    seed: int, height: float, spacing: float, actions: np.ndarray
) -> tuple[float, bool, int]:
    """Return, success and steps of an episode."""
    x = y = along = upwards = total = 0.0
    rest, fronts = 1.0, [2 + k * (spacing + 0.5) for k in range(99)]
    every = torch.arange(1, STEPS + 1).unsqueeze(-1)
    chances = uniform(torch.full_like(every, seed), every, 1).flatten().tolist()
    for step, ((push, jump), chance) in enumerate(zip(actions, chances, strict=True), 1):
        if y > 0:
            upwards -= 0.05
        else:
            along = min(max(along + 0.1 * push, -0.4), 0.4)
            upwards = 0.3 * rest * (1 - 0.1 * chance) if jump > 0 else 0.0
            rest = 0.0 if jump > 0 else min(rest + 0.2, 1.0)
        before, x, y = x, x + along, max(y + upwards, 0.0)
        fallen = y + 0.2 < height and any(front <= x < front + 0.5 for front in fronts)
        total += (x - before) / 16 - 0.1 * fallen
        if fallen or x >= 16:
            return total, not fallen, step
    return total, False, STEPS


def careful(spacing: float, distance: float, speed: float):
    """Rests before each stump, takes a run-up, and jumps a distance before it at a speed."""
    fronts = 2 + torch.arange(99) * (spacing + 0.5)

    def act(state: dict) -> torch.Tensor:
        x, _, along, _, rest = state["state"].unbind(-1)
        ahead = (fronts - x.unsqueeze(-1)).where(fronts > x.unsqueeze(-1), 99.0).amin(-1)
        rested, near = rest > 0.99, ahead < distance + 0.3
        wanted = torch.where(ahead < distance + 1.2, speed, 0.4).where(rested | ~near, 0.0)
        jump = ((ahead <= distance) & rested).float()
        return torch.stack([(wanted - along) / 0.1, 2 * jump - 1], -1)

    return act


def test_episodes_are_those_of_the_simulation() -> None:
    """Actions at random that mostly go ahead, on tracks of all kinds."""
    draws, count = np.random.default_rng(0), 30
    actions = draws.uniform([-0.5, -4], [1, 1], (count, STEPS, 2)).astype(np.float32)
    actions[..., 1] = actions[..., 1].clip(-1, 1)
    heights, spacings = draws.uniform(0, 0.6, count), draws.uniform(0, 6, count)
    heights[:3] = 0.2  # which a stride steps over
    track = {"height": torch.tensor(heights).float(), "spacing": torch.tensor(spacings).float()}
    clock = iter(range(STEPS))
    result = played(
        StumpsEnv, levels(count, **track), STEPS, lambda _: torch.tensor(actions[:, next(clock)])
    )
    for index, moves in enumerate(actions):
        wanted = [float(x) for x in simulated(index, heights[index], spacings[index], moves)]
        found = [float(result[name][index]) for name in ("return", "success", "steps")]
        assert found == pytest.approx(wanted, abs=1e-4)
    assert 3 <= result["success"].sum() < count
    assert len(result["steps"].unique()) > 10


@pytest.mark.parametrize(
    ("height", "spacing", "distance", "speed", "share"),
    [
        (0.6, 4.0, 0.8, 0.2, 1.0),
        (1.0, 6.0, 1.0, 0.2, 1.0),
        (0.6, 1.0, 0.8, 0.2, 0.0),  # the same jump as of the first, too close
        (1.3, 6.0, 1.0, 0.2, 0.0),  # as of the second, too high
    ],
)
def test_the_careful_get_over_stumps_neither_too_high_nor_too_close(
    height: float, spacing: float, distance: float, speed: float, share: float
) -> None:
    track = levels(16, height=height, spacing=spacing)
    result = played(StumpsEnv, track, STEPS, careful(spacing, distance, speed))
    assert float(result["success"].float().mean()) == share


def test_no_jump_is_higher_than_the_height_of_what_is_impossible() -> None:
    """Rested legs give a speed of 0.3, which gravity uses up in 0.3 + 0.25 + ... + 0.05."""
    result = played(StumpsEnv, levels(64, height=0.0, spacing=6.0), STEPS, careful(6.0, 1.0, 0.2))
    assert 1 < result["places"][..., 1].max() <= 1.05 < 1.3 - 0.2
    check_env_specs(StumpsEnv(levels(3, height=1.0, spacing=0.0)), break_when_any_done="both")
