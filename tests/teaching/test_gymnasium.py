"""Levels in Gymnasium's environments, alone and in vectors, and in Stable-Baselines3."""

from __future__ import annotations

import copy
import runpy
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from tensordict import TensorDict

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from tests.teaching.counting import LevelEnv, check, counted, seen, set_level

SPACE = prl.Parameters({"gravity": (5.0, 25.0)}, seeded=True)
PROGRESS = prl.curricula.learning_progress(source="episodes")


def taught(teacher: Any) -> gymnasium.Env:
    return prl.TaughtEnv(LevelEnv(), teacher, set_level)


def play(env: Any, episodes: int) -> None:
    for _ in range(episodes):
        env.reset()
        while not any(env.step(0)[2:4]):
            pass


def cartpole(
    how: Any, space: Any = SPACE, recipe: Any = "domain_randomization", **more: Any
) -> prl.TaughtEnv:
    env = gymnasium.make("CartPole-v1", max_episode_steps=20)
    return prl.TaughtEnv(env, prl.Teacher(recipe, space, block=4), how, **more)


@pytest.mark.filterwarnings("ignore")
def test_it_is_an_environment_of_gymnasium() -> None:
    """But for the levels: one that has no effect, for the same seed begins the same episode."""
    teacher = counted()
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

    env = cartpole({"gravity": "gravity"}, prl.LevelGenerator(draw))
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


def test_the_length_of_cartpole_is_all_of_what_it_computes_from_it() -> None:
    """As in an environment that was built with that length, like the example's levels."""
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "taught_sb3.py"))
    env: Any = gymnasium.make("CartPole-v1").unwrapped
    example["set_level"](env, {"gravity": 7.0, "length": 0.8})
    assert (env.gravity, env.length, env.polemass_length) == (7.0, 0.8, env.masspole * 0.8)


@pytest.mark.filterwarnings("ignore:This process")
@pytest.mark.parametrize("kind", [SyncVectorEnv, partial(AsyncVectorEnv, context="fork")])
def test_all_environments_of_a_vector_have_one_teacher(kind: Any) -> None:
    teacher = counted("success", block=3)
    given = teacher if kind is SyncVectorEnv else teacher.client()
    env = kind([partial(taught, given)] * 3)
    _, info = env.reset()
    begun = {*info["level_id"].tolist()}
    assert len(begun) == 3
    for _ in range(24):
        *_, info = env.step(env.action_space.sample())
    env.close()
    came = seen(teacher)
    check(came)
    assert len(came) > 8


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_forked_teacher_is_refused() -> None:
    teacher = counted()
    env: Any = AsyncVectorEnv([partial(taught, teacher)] * 2, context="fork", shared_memory=False)
    with pytest.raises(RuntimeError, match=r"give that process teacher\.client"):
        env.reset()
    env.close(terminate=True)


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("terminated", [1, 1, 1, 1]),
        ("truncated", [0, 0, 0, 0]),
        ("is_success", [0, 1, 1, 0]),
        (lambda info: info["truncated"], [0, 0, 0, 0]),
    ],
)
def test_success_is_what_the_rule_says(rule: Any, expected: list[int]) -> None:
    teacher = counted("success")
    play(prl.TaughtEnv(LevelEnv(), teacher, set_level, success=rule), 4)
    assert [success for _, success in seen(teacher).values()] == expected


def answering(**members: Any) -> gymnasium.Env[Any, Any]:
    return type("Odd", (LevelEnv,), members)()


def paying(reward: Any) -> gymnasium.Env[Any, Any]:
    return answering(step=lambda self, a: (LevelEnv.step(self, a)[0], reward, True, False, {}))


@pytest.mark.parametrize(
    ("env", "more", "message"),
    [
        (paying(np.nan), {"success": "terminated"}, "return_=nan: must be finite"),
        (paying(1.0), {"success": "won"}, "success='won': .* its entries: terminated, truncated$"),
        (paying(1.0), {"success": lambda last: None}, "success=.*, or the function returned None"),
        (paying(1.0), {}, "success=None: the last info .* does not"),
    ],
)
def test_what_a_step_must_not_answer(env: Any, more: Any, message: str) -> None:
    teacher = counted("success")
    env = prl.TaughtEnv(env, teacher, set_level, **more)
    env.reset()
    with pytest.raises(ArgumentError, match=message) as refused:
        env.step(0)
    assert not seen(teacher) and "\n" not in str(refused.value)


def told(outside: bool) -> dict[int, tuple[float, float]]:
    """What is told of nine episodes of three steps at most, the time limit around or inside."""
    teacher = counted("success")
    inner = LevelEnv() if outside else TimeLimit(LevelEnv(), 3)
    env: Any = prl.TaughtEnv(inner, teacher, set_level, success="terminated")
    env = TimeLimit(env, 3) if outside else env
    play(env, 9)
    env.reset()
    env.reset()  # nothing has begun
    return seen(teacher)


def test_a_time_limit_outside_is_warned_of() -> None:
    """A single episode may be cut off."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = taught(counted())
        env.reset()
        env.step(0)
        env.reset()
        right = told(outside=False)
    with pytest.warns(UserWarning, match="a second episode was cut off by a reset") as heard:
        some = told(outside=True)
    assert len(heard) == 1
    assert some == {number: one for number, one in right.items() if one[1]} != right
    assert len(right) == 9


def test_a_parameter_that_the_environment_never_gets_is_told_once() -> None:
    space = prl.Parameters({"gravity": (5.0, 25.0), "force_mag": (5.0, 15.0)}, seeded=True)
    env = cartpole({"gravity": "gravity"}, space)
    with pytest.warns(UserWarning, match="set: leaves out force_mag, so") as heard:
        env.reset()
        env.reset()
    assert len(heard) == 1


class PutsBack(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Has a gravity of its own."""

    gravity = 9.8

    def reset(self, **given: Any) -> Any:
        self.unwrapped.gravity = self.gravity  # type: ignore[attr-defined]
        return super().reset(**given)


def fixed(value: Any) -> property:
    return property(lambda self: value, lambda self, new: None)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (LevelEnv(), "LevelEnv has no attribute 'gravity'"),
        (answering(gravity=fixed(9.8)), "gravity of Odd is 9.8, not "),
        (PutsBack(answering(gravity=9.8)), "gravity of Odd is 9.8, not .*, after a reset"),
    ],
)
def test_an_attribute_that_does_not_get_there_is_found(env: Any, message: str) -> None:
    teacher = prl.Teacher("domain_randomization", prl.Parameters({"gravity": (5.0, 9.0)}))
    with pytest.raises(ArgumentError, match=f"set.gravity='gravity': {message}"):
        prl.TaughtEnv(env, teacher, {"gravity": "gravity"}).reset()


@pytest.mark.parametrize("once", [True, False])
def test_a_success_may_be_of_any_step(once: bool) -> None:
    """On every second level it is there in the first step alone, else never but every fourth."""

    def step(self: Any, action: int) -> Any:
        seen, reward, *ends, _ = LevelEnv.step(self, action)
        won = self.played % 2 == 0 and (self.steps == 1 or self.played % 4 == 0)
        return seen, reward, *ends, {"deep": {"won": np.array([won])}}

    teacher = counted("success")
    env = prl.TaughtEnv(answering(step=step), teacher, set_level, success="deep.won", once=once)
    play(env, 8)
    for number, (_, success) in seen(teacher).items():
        assert success == (number % (2 if once else 4) == 0)


def test_stable_baselines_logs_what_the_teacher_tells(tmp_path: Any) -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import configure

    from proposer_rl.teaching.sb3 import TeacherCallback

    env = cartpole({"gravity": "gravity"}, recipe=PROGRESS, success="truncated")
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, device="cpu")
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(192, callback=TeacherCallback(env._teacher))
    assert "teacher/effective_bins" in (tmp_path / "progress.csv").read_text()


@pytest.mark.parametrize("how", [set_level, "options", {"gravity": "gravity"}])
@pytest.mark.parametrize("same", [True, False])
@pytest.mark.parametrize("between", [lambda env: env, lambda env: TimeLimit(env, 50)])
def test_an_environment_has_one_teacher(between: Any, same: bool, how: Any) -> None:
    """As where a notebook's cell is run twice; what takes the place of the first goes on alone."""
    teacher, other = counted(), counted()
    first = between(taught(teacher))
    with pytest.raises(ArgumentError, match=r"^env: has a TaughtEnv already"):
        prl.TaughtEnv(first, teacher if same else other, how)
    play(first, 2)  # goes on, as nothing was put around it
    again = prl.TaughtEnv(first.unwrapped, other, set_level)
    play(again, 3)
    check(seen(other))
    assert (len(seen(teacher)), len(seen(other))) == (2, 3)
    for call in (first.reset, lambda: first.step(0)):
        with pytest.raises(ArgumentError, match=r"^env: another TaughtEnv was put around"):
            call()
    play(copy.deepcopy(prl.TaughtEnv(LevelEnv(), other.client(), set_level)), 1)
    play(again, 1)
