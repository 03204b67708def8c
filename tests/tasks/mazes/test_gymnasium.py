"""The Gymnasium environments, against Gymnasium's own checks, MazeEnv, a simulator, and clients."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env, data_equivalence
from torchrl.envs import EnvBase, GymEnv

from proposer_rl.tasks.mazes import Level, MazeEnv
from proposer_rl.tasks.mazes.as_gymnasium import LEVELS_AHEAD
from tests.tasks.mazes.oracles import path_length, play

ID = "proposer_rl/Maze-v0"
EASY: dict[str, Any] = {"obstacle_fraction": 0.2, "path_length": 3, "height": 4, "width": 5}
ROOM = "S.#\n..G"
UP, DOWN, LEFT, RIGHT = range(4)


def make(**arguments: Any) -> gymnasium.Env:
    return gymnasium.make(ID, **arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"observe_agent": True, **EASY},
        {"obstacle_fraction": [0.0, 0.3], "path_length": (2, 5), "mechanism": "path_first"},
    ],
    ids=["default", "agent", "several"],
)
def test_gymnasiums_check_finds_nothing_not_even_a_warning(arguments: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(make(**arguments).unwrapped)


@pytest.mark.parametrize("path", [3, [2, 4]])
def test_levels_are_as_specified(path: Any) -> None:
    env = make(**{**EASY, "path_length": path})
    found = set()
    for seed in [7, *[None] * (LEVELS_AHEAD + 4)]:
        observation, _ = env.reset(seed=seed)
        level = env.unwrapped.level
        assert level.walls.sum() == 4
        assert torch.equal(torch.from_numpy(observation["planes"][0]), level.walls.float())
        assert observation["agent"].tolist() == level.start.tolist()
        found.add(path_length(level))
    assert found == set(np.atleast_1d(path).tolist())


def test_the_seed_decides_the_levels() -> None:
    def levels(seed: int) -> list[str]:
        drawn = [env.reset(seed=seed)] + [env.reset() for _ in range(LEVELS_AHEAD + 3)]
        return [observation["planes"].tobytes() for observation, _ in drawn]

    env = make(**EASY)
    first, other, again = levels(1), levels(2), levels(1)
    assert first == again and not set(first) & set(other)
    assert len(set(first)) == len(first)


def test_a_level_that_is_given_is_played_for_one_episode() -> None:
    env = make(height=2, width=3, path_length=2, obstacle_fraction=0.0, render_mode="ansi")
    for level in (ROOM, Level.from_text(ROOM)):
        env.reset(options={"level": level})
        assert env.render() == "A.#\n..G"
        steps = [env.step(action) for action in (RIGHT, RIGHT, DOWN, RIGHT)]
        assert env.render() == "S.#\n..A"
        seen = [(tuple(o["agent"]), round(r, 6), t, u) for o, r, t, u, _ in steps]
        assert seen == list(play(Level.from_text(ROOM), [RIGHT, RIGHT, DOWN, RIGHT], 25, 0.01))
        with pytest.raises(ResetNeeded, match="call reset"):
            env.step(UP)
    env.reset()
    assert "#" not in env.render()


def test_a_given_level_leaves_the_drawn_ones_as_they_are() -> None:
    given = Level.from_text("S...G\n.....\n.....\n.....")
    env = make(**EASY)
    env.reset(seed=3)
    second = env.reset()[0]["planes"]
    env.reset(seed=3)
    env.reset(options={"level": given})
    assert np.array_equal(env.reset()[0]["planes"], second)


@pytest.mark.parametrize("observe_agent", [False, True])
def test_torchrl_sees_the_trajectories_of_the_maze_environment(observe_agent: bool) -> None:
    rules = {"max_steps": 6, "step_penalty": 0.125, "observe_agent": observe_agent}
    env = GymEnv(ID, **EASY, **rules)
    env.set_seed(0)
    actions = torch.randint(4, (40, 1), generator=torch.Generator().manual_seed(0))
    episodes = 0
    while len(actions) > 0:
        played = follow(env, actions, env.reset(), one_hot=True)
        same = MazeEnv(env.unwrapped.level, **rules)
        assert_same_steps(played, follow(same, actions, same.reset()))
        actions, episodes = actions[len(played) :], episodes + 1
    assert episodes > 5


def follow(env: EnvBase, actions: torch.Tensor, state: Any, one_hot: bool = False) -> list[Any]:
    """One episode, from the state after its reset."""
    steps = []
    for action in actions:
        encoded = torch.eye(4, dtype=torch.int64)[action[0]] if one_hot else action[0]
        state = env.step(state.set("action", encoded))["next"]
        steps.append(state)
        if state["done"].any():
            break
    return steps


def assert_same_steps(some: list[Any], others: list[Any]) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        for key in ("planes", "agent", "reward", "terminated", "truncated", "done"):
            assert torch.equal(one[key], other[key]), key
            assert one[key].dtype == other[key].dtype


def test_pictures() -> None:
    env = make(render_mode="rgb_array", **EASY)
    env.reset(seed=0)
    picture = env.render()
    assert (picture.shape, picture.dtype) == ((65, 81, 3), np.uint8)
    assert np.array_equal(picture, MazeEnv(env.unwrapped.level).render().numpy())
    assert make(**EASY).unwrapped.render() is None


def test_gymnasium_makes_a_vector_of_them() -> None:
    """What comes out is each maze's own, and is not changed by later steps."""
    envs = gymnasium.make_vec(ID, num_envs=3, max_steps=5, **EASY)
    kept = [envs.reset(seed=5)[0]]
    kept += [envs.step(np.full(3, action))[0] for action in (UP, DOWN, LEFT, RIGHT) * 3]
    alone = make(max_steps=5, **EASY)
    assert np.array_equal(kept[0]["planes"][2], alone.reset(seed=7)[0]["planes"])
    copies = [{key: value.copy() for key, value in each.items()} for each in kept]
    for _ in range(20):
        envs.step(np.full(3, RIGHT))
    assert data_equivalence(kept, copies, exact=True)


def test_paths_that_are_too_long_for_an_episode_are_refused() -> None:
    with pytest.raises(ValueError, match="max_steps=25: must be at least the path length 30"):
        make(path_length=30)


@pytest.mark.parametrize("level", [ROOM, "S.X", ["S...G\n.....\n.....\n....."] * 3])
def test_what_is_no_level_of_the_grid_is_refused(level: Any) -> None:
    with pytest.raises((ValueError, RuntimeError)):
        make(**EASY).reset(options={"level": level})


@pytest.mark.parametrize("action", [4, -1, 0.5])
def test_bad_actions_are_refused(action: Any) -> None:
    env = make(disable_env_checker=True, **EASY)
    env.reset(seed=0)
    with pytest.raises(AssertionError, match="invalid"):
        env.unwrapped.step(action)
