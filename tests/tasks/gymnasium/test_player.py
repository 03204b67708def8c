"""Levels arrive in the environment, and are the same whatever was played before."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from proposer_rl.tasks.gymnasium.batched_env import plays
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
)
from proposer_rl.tasks.ranges import spaces
from tests.tasks.gymnasium.toys import LIMIT, NO_BOX2D, PARAMETERS, WALK, Walk

LEVEL = {"speed": 1.25, "width": 2.0, "begin": 1, "wind": -1}
CARTPOLE = {
    "length": ParameterSettings(
        set="call", name="proposer_rl.tasks.gymnasium.cartpole.set_length", values=[1], target=1
    ),
    "force": ParameterSettings(name="force_mag", values=[1], target=1),
    "gravity": ParameterSettings(values=[1], target=1),
}


STUMPED = "proposer_rl.tasks.gymnasium.stumps"


def argument(**more: Any) -> ParameterSettings:
    return ParameterSettings(set="argument", values=[0], target=0, **more)


def test_each_number_gets_where_it_belongs() -> None:
    player = LevelPlayer(MakeEnvironment(WALK), PARAMETERS, GymLevel(LEVEL, 7))
    inner: Any = player.unwrapped
    player.reset(seed=99)
    assert (inner.engine.speed, inner.width, inner.wind) == (1.25, 2.0, -0.1)
    assert inner.kept == [(7, {"start": 1})]
    player.play = GymLevel({**LEVEL, "wind": 1}, 8)
    player.reset()
    assert player.unwrapped is inner and inner.wind == 0.1  # nothing had to be built
    player.play = GymLevel({**LEVEL, "width": 1.0}, 8)
    player.reset()
    again: Any = player.unwrapped
    assert again is not inner and (again.width, again.engine.speed) == (1.0, 1.25)


def keeping(self: Walk, *, seed: Any = None, options: Any = None) -> Any:
    """Resets, whatever the options are."""
    self.kept.append((seed, options))
    return np.zeros(2), {}


CELLS, MAPS = [[1, 1], [3, 4]], [["SF", "FG"], ["SH", "FG"]]


@pytest.mark.parametrize(
    ("env_id", "way", "name", "values", "found"),
    [
        (WALK, "option", "start", ["left", "right"], lambda env: env.kept[-1][1]["start"]),
        (WALK, "option", "cell", CELLS, lambda env: env.kept[-1][1]["cell"]),
        (WALK, "attribute", "engine.memory", [False, True], lambda env: env.engine.memory),
        (WALK, "attribute", "kept", CELLS, lambda env: env.kept[:2]),
        ("FrozenLake-v1", "argument", "desc", MAPS, lambda env: env.desc.astype(str).tolist()),
    ],
)
@pytest.mark.parametrize("numbered", [False, True])
def test_a_value_may_be_anything(
    numbered: bool,
    env_id: str,
    way: Any,
    name: str,
    values: list[Any],
    found: Any,
    monkeypatch: Any,
) -> None:
    """As it stands, or for a number that says where it is in an order."""
    monkeypatch.setattr(Walk, "reset", keeping)
    said: Any = {"values": [1, 5], "to": values, "target": 5}
    said = said if numbered else {"values": values, "target": values[1]}
    parameters = {"a": ParameterSettings(set=way, name=name, **said)}
    space, target = spaces(parameters)
    assert target.sample(3, torch.Generator())["a"].tolist() == [5 if numbered else 1] * 3
    levels = space.generate(torch.tensor([[1, 1, 0]]), [torch.Generator()])
    played = plays(levels, parameters)
    player = LevelPlayer(MakeEnvironment(env_id), parameters, played[0])
    for play, value in zip(played, (values[1], values[1], values[0]), strict=True):
        player.play = play
        player.reset()
        now = found(player.unwrapped)
        assert now == (value if name != "desc" else [[*row] for row in value])
        if isinstance(now, list):
            now.append("spoilt")


def test_once_it_stands_still_after_an_episode() -> None:
    player = LevelPlayer(MakeEnvironment(WALK), PARAMETERS, GymLevel(LEVEL, 7), once=True)
    for _ in range(2):
        player.play = GymLevel({**LEVEL, "speed": 0.5}, 7)
        player.reset()
        ends = [player.step(1)[3] for _ in range(LIMIT)]
        assert ends == [False] * (LIMIT - 1) + [True]
        last = player.reset()[0]
        for _ in range(2 * LIMIT):
            seen, reward, terminated, truncated, _ = player.step(2)
            assert np.array_equal(seen, last)
            assert (reward, terminated, truncated) == (0, False, False)


def steps(player: LevelPlayer, play: GymLevel, count: int = 40) -> list[np.ndarray]:
    player.play = play
    numbers = np.random.default_rng(0)
    seen = [np.asarray(player.reset()[0]).ravel()]
    for _ in range(count):
        space: Any = player.action_space
        discrete = isinstance(space, gymnasium.spaces.Discrete)
        action = numbers.integers(space.n) if discrete else numbers.uniform(-1, 1, space.shape)
        now, reward, terminated, truncated, _ = player.step(action)
        seen.append(np.append(np.asarray(now).ravel(), reward))
        if terminated or truncated:
            break
    return seen


def numbers(*names: str, **named: str) -> dict[str, ParameterSettings]:
    given = {**{name: name for name in names}, **named}
    return {n: ParameterSettings(name=to, values=[1], target=1) for n, to in given.items()}


STUMPS = ("stump_height", "stump_spacing")
WIND = {"arguments": {"enable_wind": True}}
CHEETAH = numbers(gravity="model.opt.gravity.2", mass="model.body_mass.1")
ROOMS = {"size": argument(), "crossings": argument(name="num_crossings")}
SYMBOLS = {"wrappers": ["minigrid.wrappers.ImgObsWrapper"]}
CROSSING, TRACK = "minigrid:MiniGrid-SimpleCrossingS9N1-v0", f"{STUMPED}:BipedalStumps-v0"


@pytest.mark.parametrize(
    ("env_id", "more", "parameters", "values"),
    [
        ("CartPole-v1", {}, CARTPOLE, [(0.5, 9.0, 5.0), (1.0, 4.0, 20.0)]),
        ("LunarLander-v3", WIND, numbers("gravity", "wind_power"), [(-5.0, 10.0), (-10.0, 2.0)]),
        pytest.param(TRACK, {}, numbers(*STUMPS), [(0.5, 3.0), (2.0, 1.5)], marks=NO_BOX2D),
        ("HalfCheetah-v5", {}, CHEETAH, [(-9.81, 6.0), (-6.0, 9.0)]),
        (CROSSING, SYMBOLS, ROOMS, [(9, 2), (7, 1)]),
    ],
)
def test_a_level_is_the_same_in_new_and_in_used_environments(
    env_id: str, more: dict, parameters: dict, values: list
) -> None:
    make = MakeEnvironment(env_id, **more)
    one, other = (dict(zip(parameters, row, strict=True)) for row in values)
    used = LevelPlayer(make, parameters, GymLevel(one, 0))
    played = [
        steps(used, play)
        for play in (
            GymLevel(one, 5),
            GymLevel(other, 9),
            GymLevel(one, 5),
            GymLevel(one, 5),
            GymLevel(other, 5),
        )
    ]
    fresh = steps(LevelPlayer(make, parameters, GymLevel(other, 1)), GymLevel(one, 5))
    for again in (played[2], played[3], fresh):
        assert len(again) == len(played[0])
        assert all(np.array_equal(a, b) for a, b in zip(again, played[0], strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(played[4], played[0], strict=False))


def test_a_longer_pole_obeys_the_equations_of_motion() -> None:
    """Barto, Sutton and Anderson 1983, without friction, with the pole's half length and masses."""
    length, mass, force, gravity = 0.8, 0.1, 7.0, 15.0
    values = {"length": length, "force": force, "gravity": gravity}
    player = LevelPlayer(MakeEnvironment("CartPole-v1"), CARTPOLE, GymLevel(values, 3))
    _, speed, angle, turn = map(float, player.reset()[0])
    seen = player.step(1)[0]
    total = 1.0 + mass
    push = (force + mass * length * turn**2 * math.sin(angle)) / total
    turning = (gravity * math.sin(angle) - math.cos(angle) * push) / (
        length * (4 / 3 - mass * math.cos(angle) ** 2 / total)
    )
    moving = push - mass * length * turning * math.cos(angle) / total
    assert seen[1] == pytest.approx(speed + 0.02 * moving, abs=1e-5)
    assert seen[3] == pytest.approx(turn + 0.02 * turning, abs=1e-5)


@NO_BOX2D
def test_stumps_stand_where_they_are_asked_for() -> None:
    """As high and as far apart as the level says, by the bodies in Box2D's world."""
    play = GymLevel(dict(zip(STUMPS, (1.5, 4.0), strict=True)), 3)
    player = LevelPlayer(MakeEnvironment(TRACK), numbers(*STUMPS), play)
    player.reset()
    inner: Any = player.unwrapped
    boxes = [body.fixtures[0].shape.vertices for body in inner.terrain]
    stumps = [[*map(tuple, corners)] for corners in boxes if len(corners) == 4]
    lefts = sorted(min(x for x, _ in corners) for corners in stumps)
    rights = sorted(max(x for x, _ in corners) for corners in stumps)
    gaps = [left - right for left, right in zip(lefts[1:], rights[:-1], strict=True)]
    assert len(stumps) > 10 and gaps == pytest.approx([4.0] * len(gaps), abs=1e-3)
    heights = [max(y for _, y in c) - min(y for _, y in c) for c in stumps]
    assert heights == pytest.approx([1.5] * len(heights), abs=1e-3)
