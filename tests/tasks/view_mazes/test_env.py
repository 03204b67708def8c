"""The field's maze, step by step against MiniGrid's environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import check_env_specs

from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv
from research.benchmarks.minigrid_env import MiniGridMaze
from tests.tasks.view_mazes.oracles import random_levels

LEVELS, STEPS, LIMIT = 1000, 10, 7


def arrays(state: TensorDictBase) -> dict[str, Any]:
    return {str(key): entry.numpy() for key, entry in state.items() if key != "next"}


def assert_same(state: dict[str, Any], i: int, seen: dict[str, Any], oracle: MiniGridMaze) -> None:
    assert np.array_equal(state["view"][i], seen["image"][:, :, 0])
    assert state["direction"][i] == seen["direction"]
    column, row = oracle.agent_pos
    assert state["agent"][i].tolist() == [row - 1, column - 1]


def test_it_does_what_minigrid_does() -> None:
    """10,000 random steps on 1,000 levels: observations, rewards, ends, and resets to the start."""
    levels = random_levels(LEVELS)
    env = ViewMazeEnv(levels, max_steps=LIMIT)
    oracles = [MiniGridMaze(levels[i], LIMIT) for i in range(LEVELS)]
    seen = [oracle.reset()[0] for oracle in oracles]
    state = env.reset()
    ends = {"terminated": 0, "truncated": 0}
    draw = torch.Generator().manual_seed(1)
    for _ in range(STEPS):
        # Twice as many moves as turns of either kind.
        action = torch.randint(4, (LEVELS,), generator=draw).clamp(max=2)
        stepped, following = env.step_and_maybe_reset(state.set("action", action))
        before, after = arrays(state), arrays(stepped["next"])
        for i, oracle in enumerate(oracles):
            assert_same(before, i, seen[i], oracle)
            seen[i], reward, terminated, truncated, _ = oracle.step(int(action[i]))
            assert_same(after, i, seen[i], oracle)
            assert after["reward"][i, 0] == pytest.approx(reward, abs=1e-6)
            assert after["terminated"][i, 0] == terminated
            # MiniGrid calls the last step truncated even where it reaches the goal.
            assert after["truncated"][i, 0] == (truncated and not terminated)
            assert after["done"][i, 0] == (terminated or truncated)
            ends["terminated"] += terminated
            ends["truncated"] += truncated
            if terminated or truncated:
                seen[i] = oracle.reset()[0]
        state = following
    assert min(ends.values()) > LEVELS / 10


def test_its_specifications_hold() -> None:
    check_env_specs(ViewMazeEnv(random_levels(6).reshape(2, 3)), break_when_any_done="both")
    check_env_specs(ViewMazeEnv(random_levels(1)[0], max_steps=3))


def test_an_episode_begins_where_is_init_says() -> None:
    env = ViewMazeEnv(random_levels(50), max_steps=4)
    rollout = env.rollout(12, break_when_any_done=False)
    begins, done = rollout["is_init"], rollout["next", "done"]
    assert begins[:, 0].all() and torch.equal(begins[:, 1:], done[:, :-1])
    assert not rollout["next", "is_init"].any()
    assert torch.equal(begins, rollout["step_count"] == 0)


def test_new_levels_are_played_from_the_next_reset_on() -> None:
    first, second = random_levels(40), random_levels(40, seed=1)
    env = ViewMazeEnv(first, max_steps=3)
    state = env.reset()
    env.set_levels(second)
    assert torch.equal(env.levels.start, first.start)
    for _ in range(3):
        turn = torch.zeros(40, dtype=torch.int64)  # no goal is reached
        stepped, state = env.step_and_maybe_reset(state.set("action", turn))
    assert stepped["next", "done"].all()
    begun = ViewMazeEnv(second).reset()
    for key in ("view", "direction", "agent"):
        assert torch.equal(state[key], begun[key])
    assert torch.equal(env.reset()["view"], begun["view"])
