"""Levels in Gymnasium's environments, alone and in vectors, and in Stable-Baselines3."""

from __future__ import annotations

import runpy
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from tensordict import TensorDict

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from tests.teaching.counting import ITEMS, Counting, LevelEnv, check, set_level

SPACE = prl.Parameters({"gravity": (5.0, 25.0), "ground": ["flat", "stairs"]}, seeded=True)


def taught(teacher: Any) -> gymnasium.Env:
    return prl.TaughtEnv(LevelEnv(), teacher, set_level)


def cartpole(how: Any, **more: Any) -> prl.TaughtEnv:
    teacher = prl.Teacher("domain_randomization", SPACE)
    return prl.TaughtEnv(gymnasium.make("CartPole-v1"), teacher, how, **more)


@pytest.mark.filterwarnings("ignore")
def test_it_is_an_environment_of_gymnasium() -> None:
    """But for the levels: one that has no effect, for the same seed begins the same episode."""
    teacher = prl.Teacher(Counting(), ITEMS)
    env = prl.TaughtEnv(LevelEnv(), teacher, lambda env, level: None)
    check_env(env, skip_render_check=True)


def test_the_level_is_in_the_environment_and_in_info() -> None:
    env = cartpole({"gravity": "gravity"})
    seen, info = env.reset()
    level = info["level"]
    assert env.unwrapped.gravity == level["gravity"] and info["level_id"] == 0
    expected, _ = gymnasium.make("CartPole-v1").reset(seed=level["seed"])
    np.testing.assert_array_equal(seen, expected)
    done = False
    while not done:
        *_, terminated, truncated, info = env.step(0)
        done = terminated or truncated
    assert info["level"] == level
    assert env.reset()[1]["level_id"] == 1
    assert env.reset()[1]["level_id"] == 2  # what is cut off counts for nothing


def test_numbers_of_a_generator_are_numbers_of_the_environment() -> None:
    def draw(count: int, generator: Any) -> TensorDict:
        gravity = torch.rand(count, generator=generator) + 5
        return TensorDict({"gravity": gravity, "seed": torch.arange(count)}, [count])

    teacher = prl.Teacher("domain_randomization", prl.LevelGenerator(draw))
    env = prl.TaughtEnv(gymnasium.make("CartPole-v1"), teacher, {"gravity": "gravity"})
    seen, info = env.reset()
    assert env.unwrapped.gravity == float(info["level"]["gravity"])
    assert type(env.unwrapped.gravity) is float
    np.testing.assert_array_equal(seen, gymnasium.make("CartPole-v1").reset(seed=0)[0])


def test_levels_may_be_options_of_a_reset() -> None:
    class Told(LevelEnv):
        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            self.options = options
            return super().reset(seed=seed)

    teacher = prl.Teacher("domain_randomization", SPACE)
    env = prl.TaughtEnv(Told(), teacher, "options")
    _, info = env.reset(options={"more": 1})
    assert env.unwrapped.options == {"more": 1, **info["level"]}


class Parts(LevelEnv):
    """With numbers in arrays, a text and a truth value."""

    def __init__(self) -> None:
        self.model = SimpleNamespace(opt=SimpleNamespace(gravity=np.array([0.0, 0.0, -9.81])))
        self.ground, self.windy, self.masses = "flat", False, {"torso": 1.0}


def parts(**sets: str) -> Any:
    ranges = {
        "g": (-9.5, -9.4),
        "ground": ["grass", "stairs"],
        "windy": [True],
        "mass": range(2, 5),
    }
    teacher = prl.Teacher("domain_randomization", prl.Parameters(ranges))
    env = prl.TaughtEnv(Parts(), teacher, sets)
    return env.unwrapped, env.reset()[1]["level"]


def test_attributes_lie_in_parts_of_the_environment_and_in_arrays() -> None:
    env, level = parts(g="model.opt.gravity.2", ground="ground", windy="windy", mass="masses.torso")
    assert env.model.opt.gravity.tolist() == [0.0, 0.0, level["g"]]
    assert (env.ground, env.windy, env.masses) == (level["ground"], True, {"torso": level["mass"]})


@pytest.mark.parametrize(
    ("sets", "message"),
    [
        ({"g": "model.opt.gravity"}, r"set.g='model.opt.gravity': .* shape \[3\]; name one of its"),
        ({"g": "ground"}, "set.g='ground': ground is no number but a str"),
        ({"ground": "masses.torso"}, "set.ground='masses.torso': masses.torso is a number, 1.0, and no place"),
        ({"ground": "floor"}, "set.ground='floor': Parts has no attribute 'floor'"),
    ],
)
def test_a_number_is_put_in_the_place_of_one(sets: dict[str, str], message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        parts(**sets)


def test_the_length_of_cartpole_is_all_of_what_it_computes_from_it() -> None:
    """As an environment that was built with that length; the example's levels are so."""
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "taught_sb3.py"))
    env: Any = gymnasium.make("CartPole-v1").unwrapped
    example["set_level"](env, {"gravity": 7.0, "length": 0.8})
    assert (env.gravity, env.length, env.polemass_length) == (7.0, 0.8, env.masspole * 0.8)


@pytest.mark.filterwarnings("ignore:This process")
@pytest.mark.parametrize("kind", [SyncVectorEnv, partial(AsyncVectorEnv, context="fork")])
def test_all_environments_of_a_vector_have_one_teacher(kind: Any) -> None:
    curriculum = Counting("success")
    teacher = prl.Teacher(curriculum, ITEMS, block=3)
    given = teacher if kind is SyncVectorEnv else teacher.client()
    env = kind([partial(taught, given)] * 3)
    _, info = env.reset()
    begun = {*info["level_id"].tolist()}
    assert len(begun) == 3
    for _ in range(24):
        *_, info = env.step(env.action_space.sample())
    env.close()
    teacher.propose(1)  # takes in what was told
    check(curriculum.seen)
    assert len(curriculum.seen) > 8


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_forked_teacher_is_refused() -> None:
    teacher = prl.Teacher(Counting(), ITEMS)
    env: Any = AsyncVectorEnv([partial(taught, teacher)] * 2, context="fork", shared_memory=False)
    with pytest.raises(RuntimeError, match=r"give that process teacher\.client"):
        env.reset()
    env.close(terminate=True)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: cartpole("attributes"), "set='attributes': must be"),
        (lambda: cartpole({"gravity": "gravty"}).reset(), "set.gravity='gravty': CartPoleEnv has"),
        (lambda: cartpole({"gravity": "a.b"}).reset(), "set.gravity='a.b': CartPoleEnv has no"),
        (lambda: cartpole({"mass": "gravity"}).reset(), "set.mass: no parameter; there are: grav"),
        (
            lambda: prl.TaughtEnv(LevelEnv(), prl.Teacher(Counting(), ITEMS), {"g": "g"}).reset(),
            "set.g: no parameter; there are: none",
        ),
    ],
)
def test_what_is_wrong_is_named(make: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        make()


RULES = {
    "terminated": 1.0,
    "truncated": 0.0,
    "is_success": None,
    "a function": 0.0,
}


@pytest.mark.parametrize("rule", RULES)
def test_success_is_what_the_rule_says(rule: str) -> None:
    how: Any = (lambda info: info["truncated"]) if rule == "a function" else rule
    curriculum = Counting("success")
    teacher = prl.Teacher(curriculum, ITEMS)
    env = prl.TaughtEnv(LevelEnv(), teacher, set_level, success=how)
    for _ in range(4):
        env.reset()
        while not env.step(0)[2]:
            pass
    teacher.propose(1)  # takes in what was told
    expected = {0: 0.0, 1: 1.0, 2: 1.0, 3: 0.0} if RULES[rule] is None else {}
    assert {n: s for n, (_, s) in curriculum.seen.items()} == {
        n: expected.get(n, RULES[rule]) for n in range(4)
    }


def test_success_is_asked_for_where_nothing_says_it() -> None:
    teacher = prl.Teacher(prl.curricula.learning_progress(source="episodes"), SPACE)
    env = prl.TaughtEnv(gymnasium.make("CartPole-v1"), teacher, {"gravity": "gravity"})
    env.reset()
    with pytest.raises(ArgumentError, match="success=None: the last info has no such entry"):
        while not env.step(0)[2]:
            pass


def test_stable_baselines_logs_what_the_teacher_tells(tmp_path: Any) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import configure

    from proposer_rl.teaching.sb3 import TeacherCallback

    teacher = prl.Teacher(prl.curricula.learning_progress(source="episodes"), SPACE, block=4)
    env = prl.TaughtEnv(
        gymnasium.make("CartPole-v1", max_episode_steps=20),
        teacher,
        {"gravity": "gravity"},
        success="truncated",
    )
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, device="cpu")
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(192, callback=TeacherCallback(teacher))
    assert "teacher/effective_bins" in (tmp_path / "progress.csv").read_text()
