"""The point mass against an integrator in plain Python, and on ways that anybody can follow."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from proposer_rl.streams import Streams
from proposer_rl.tasks.point_masses import PointMassEnv
from tests.tiny import point_masses

DOWN, UP, RIGHT = (0.0, -1.0), (0.0, 1.0), (1.0, 0.0)


Level = tuple[float, float, float]


def gates(*levels: Level) -> TensorDict:
    columns = torch.tensor(levels, dtype=torch.float64).unbind(-1)
    names = ("position", "width", "friction")
    return TensorDict(dict(zip(names, columns, strict=True)), [len(levels)])


def integrated(
    state: list[float], level: Level, action: list[float]
) -> tuple[list[float], bool, float]:
    """A step as Klink et al. define it, substep by substep, without noise.

    With whether it hits the wall, and how far from a post it gets to the wall at the closest.
    """
    position, width, friction = level
    fx, fy = (10 * max(-1.0, min(1.0, share)) for share in action)
    closest = math.inf
    for _ in range(10):
        x, vx, y, vy = state
        new_x, new_y = (max(-4.0, min(4.0, p + 0.01 * v)) for p, v in ((x, vx), (y, vy)))
        if (y >= 0 > new_y) or (y <= 0 < new_y):
            there = x + y / (y - new_y) * (new_x - x)
            beyond = abs(there - position) - width / 2
            closest = min(closest, abs(beyond))
            if beyond > 0:
                return [there, 0.0, 0.0, 0.0], True, closest
        new_vx, new_vy = (v + 0.01 * (1.5 * f - friction * v) for v, f in ((vx, fx), (vy, fy)))
        state = [new_x, new_vx, new_y, new_vy]
    return state, False, closest


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, width=32)


LEVEL = st.tuples(numbers(-4, 4), numbers(0.5, 8), numbers(0, 4))
# No mass stands on the wall's line but where it has hit the wall.
PLACE = st.one_of(numbers(-4, -(2**-9)), numbers(2**-9, 4))
CASE = st.tuples(
    LEVEL,
    numbers(-4, 4),
    numbers(-9, 9),
    PLACE,
    numbers(-9, 9),
    numbers(-1.5, 1.5),
    numbers(-1.5, 1.5),
)


@given(st.lists(CASE, min_size=1, max_size=20))
def test_steps_are_those_of_the_published_dynamics(cases: list) -> None:
    env = PointMassEnv(gates(*(level for level, *_ in cases)))
    state = env.reset()
    state["observation"][:, :4] = torch.tensor([case[1:5] for case in cases])
    after = env.step(state.set("action", torch.tensor([case[5:] for case in cases])))["next"]
    for came, (level, *mass, fx, fy) in zip(after, cases, strict=True):
        wanted, hit, closest = integrated(mass, level, [fx, fy])
        if closest < 1e-4:  # a matter of rounding
            continue
        assert bool(came["terminated"]) == hit
        seen = came["observation"].tolist()
        assert seen == pytest.approx([*wanted, *level], abs=1e-4, rel=1e-4)
        away = math.dist((seen[0], seen[2]), (0, -3))
        assert float(came["reward"]) == pytest.approx(math.exp(-0.6 * away), rel=1e-5)


def fly(level: Level, *forces: tuple[float, float], steps: int = 100) -> list:
    """The states after steps with these forces in turn, the last one for the rest."""
    env = PointMassEnv(gates(level), max_steps=steps)
    state, states = env.reset(), []
    for number in range(steps):
        force = torch.tensor([forces[min(number, len(forces) - 1)]])
        state = env.step(state.set("action", force))["next"]
        states.append(state[0])
        if bool(state["done"]):
            break
        state = state.exclude("reward")
    return states


@pytest.mark.parametrize(
    ("level", "forces", "hits"),
    [
        ((0.0, 0.5, 0.0), [DOWN], False),  # straight through
        ((0.26, 0.5, 0.0), [DOWN], True),  # a hundredth beside the post
        ((0.24, 0.5, 0.0), [DOWN], False),
        ((2.5, 0.5, 0.0), [DOWN], True),
        ((0.0, 0.5, 0.0), [RIGHT, DOWN], True),  # drifting to the right
        ((1.0, 8.0, 0.0), [RIGHT, DOWN], False),
        ((0.0, 0.5, 0.0), [UP], False),  # it never gets to the wall
    ],
)
def test_a_mass_passes_the_gate_and_nothing_else(level: Level, forces: list, hits: bool) -> None:
    *_, last = fly(level, *forces, steps=15)
    assert bool(last["terminated"]) == hits and bool(last["truncated"]) != hits
    if hits:
        _, x_speed, y, y_speed, *_ = last["observation"].tolist()
        assert (x_speed, y, y_speed) == (0.0, 0.0, 0.0)


def test_success_is_to_be_at_the_goal_in_the_end() -> None:
    """A controller flies there and stays; one that only flies by has not succeeded."""
    env = PointMassEnv(gates((0.0, 1.0, 0.0)), max_steps=60)
    state, successes = env.reset(), []
    for _ in range(60):
        _, _, y, speed, *_ = state["observation"][0].tolist()
        force = torch.tensor([[0.0, -0.2 * (y + 3) - 0.2 * speed]])
        state = env.step(state.set("action", force))["next"]
        successes.append(bool(state["success"]))
        state = state.exclude("reward")
    assert successes == [False] * 59 + [True] and bool(state["truncated"])
    by = fly((0.0, 1.0, 0.0), DOWN, steps=100)
    assert not any(bool(state["success"]) for state in by)
    assert any(abs(float(state["observation"][2]) + 3) < 0.25 for state in by)


def test_the_target_is_where_it_is_said_to_be() -> None:
    task: Any = point_masses()
    levels = task.target.sample(500, Streams(0).generator())
    assert float(levels["position"].mean()) == pytest.approx(2.5, abs=1e-3)
    assert float(levels["position"].std()) == pytest.approx(0.004, abs=1e-3)
    assert set(levels["width"].tolist()) == {0.5} and set(levels["friction"].tolist()) == {0.0}
    (bin_,) = (task.target_shares > 0.5).nonzero().flatten().tolist()
    place = [part.item() for part in torch.unravel_index(torch.tensor(bin_), (8, 5, 2))]
    assert place == [6, 0, 0]
