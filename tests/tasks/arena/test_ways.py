"""Corridors, ice, the ferry and the crowd against walks, chains and simulations by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import check_env_specs

from proposer_rl.tasks.arena.ways import CrowdEnv, FerryEnv, ForkEnv, IceEnv, RecallEnv
from proposer_rl.tasks.batched_envs import uniform
from tests.tasks.arena.episodes import levels, play, played

BOTH = levels(depth=[0.1, 0.96, 0.98, 1.0], length=[6, 2, 6, 2])


def test_going_right_is_right_on_all_levels_but_the_deep() -> None:
    env = ForkEnv(BOTH, max_steps=24)
    returns, success = play(env, lambda _: torch.ones(4, dtype=torch.int64))
    assert success.tolist() == [True, True, False, False]
    assert returns.tolist() == [1, 1, 0, 0]
    assert play(env, lambda _: torch.zeros(4, dtype=torch.int64))[1].equal(~success)


def test_an_episode_ends_where_a_walk_by_hand_does() -> None:
    env = ForkEnv(BOTH, max_steps=24)
    walk = [0, 1, 1, 1, 0, 1, 1, 1, 1, 1]  # visits -1 and then 2
    place, ends = 0, [0] * 4
    for step, action in enumerate(walk, 1):
        place += 2 * action - 1
        for i, (length, side) in enumerate([(6, 1), (2, 1), (6, -1), (2, -1)]):
            ends[i] = ends[i] or (step if side * place >= length or side * place <= -2 else 0)
    now, seen = env.reset(), [0] * 4
    for step, action in enumerate(walk, 1):
        now = env.step(now.set("action", torch.full((4,), action)))["next"]
        for i, done in enumerate(now["done"].squeeze(-1).tolist()):
            seen[i] = seen[i] or (step if done else 0)
    assert seen == ends


class Walker:
    """Walks on to the end, and goes through the door that it saw first, or last."""

    def __init__(self, first: bool) -> None:
        self.first, self.door = first, None

    def __call__(self, state: dict) -> torch.Tensor:
        number, last = state["observation"][..., :4], state["observation"][..., 5]
        shown = number.argmax(-1)
        if self.door is None:
            self.door = shown
        elif not self.first:
            self.door = torch.where(number.any(-1), shown, self.door)
        return torch.where(last > 0, 1 + self.door, 0)


@pytest.mark.parametrize("length", [2, 5, 12])
def test_what_was_shown_first_opens_the_right_door(length: int) -> None:
    result = played(RecallEnv, levels(200, length=length, noise=1.0), 24, Walker(first=True))
    assert result["success"].all() and (result["steps"] == length).all()
    assert (result["return"] == 1).all()


def test_what_is_shown_on_the_way_means_nothing() -> None:
    by_chance = played(RecallEnv, levels(2000, length=6, noise=1.0), 24, Walker(first=False))
    assert float(by_chance["success"].float().mean()) == pytest.approx(1 / 4, abs=0.04)
    quiet = played(RecallEnv, levels(200, length=6, noise=0.0), 24, Walker(first=False))
    assert quiet["success"].all()


def test_the_door_cannot_be_read_off_later_and_doors_are_equally_likely() -> None:
    env = RecallEnv(levels(2000, length=6, noise=0.0))
    state = env.reset()
    share = state["observation"][..., :4].mean(0)
    assert share.tolist() == pytest.approx([0.25] * 4, abs=0.04)
    later = env.step(state.set("action", torch.zeros(2000, dtype=torch.long)))["next"]
    assert later["observation"].unique(dim=0).shape[0] == 1
    check_env_specs(RecallEnv(levels(3, length=6, noise=0.5)), break_when_any_done="both")


EPISODES, STEPS = 4000, 40


def chain(length: int, width: int, slip: float) -> float:
    """How often the end is reached by stepping back to the middle, and else ahead."""
    here = np.zeros((length + 1, width + 2))  # pits at both ends of a row
    here[0, width // 2 + 1] = 1
    for _ in range(STEPS):
        then = np.zeros_like(here)
        for x, y in np.ndindex(*here.shape):
            if x == length or y in (0, width + 1):
                then[x, y] += here[x, y]
                continue
            turn = np.sign(width // 2 + 1 - y)
            then[x + (turn == 0), y + turn] += (1 - slip) * here[x, y]
            then[x, y - 1] += slip / 2 * here[x, y]
            then[x, y + 1] += slip / 2 * here[x, y]
        here = then
    return float(here[length, 1:-1].sum())


@pytest.mark.parametrize(("length", "width", "slip"), [(14, 1, 0.0), (14, 3, 0.3), (6, 5, 0.4)])
def test_successes_are_as_frequent_as_the_chain_says(length: int, width: int, slip: float) -> None:
    same = {"length": length, "width": width, "slip": slip}
    many = {name: torch.full((EPISODES,), value) for name, value in same.items()}
    env = IceEnv(levels(seed=torch.arange(EPISODES), **many), max_steps=STEPS)

    def careful(now: TensorDictBase) -> torch.Tensor:
        left, right = now["observation"][..., 1], now["observation"][..., 2]
        return torch.where(left > right, 1, torch.where(left < right, 2, 0))

    returns, success = play(env, careful)
    assert float(success.float().mean()) == pytest.approx(chain(length, width, slip), abs=0.03)
    assert set(returns[~success].tolist()) <= {torch.tensor(-0.1).item(), 0.0}


def test_who_waits_runs_out_of_time_without_a_cost() -> None:
    env = IceEnv(levels(length=[4], width=[3], slip=[0.0], seed=[1]), max_steps=STEPS)
    assert [float(result) for result in play(env, lambda _: torch.tensor([3]))] == [0.0, 0.0]


def steered(state: dict) -> torch.Tensor:
    aside, _, current, _ = state["observation"].unbind(-1)
    return (-current - 10 * aside).unsqueeze(-1)


def still(state: dict) -> torch.Tensor:
    return torch.zeros(len(state), 1)


@pytest.mark.parametrize(
    ("current", "width", "act", "share"),
    [
        (0.7, 0.2, steered, 1.0),
        (-0.7, 0.2, steered, 1.0),
        (0.7, 0.2, still, 0.0),
        (2.0, 2.0, steered, 0.0),  # stronger than any rudder
        (0.0, 2.0, still, 1.0),
    ],
)
def test_who_lands(current: float, width: float, act: object, share: float) -> None:
    result = played(FerryEnv, levels(100, current=current, width=width), 20, act)
    assert float(result["success"].float().mean()) == share
    assert (result["steps"] == 20).all() and (result["return"] == result["success"]).all()


def test_gusts_are_fair_and_a_level_has_its_own() -> None:
    level = levels(2000, current=0.0, width=0.1)
    ends = played(FerryEnv, level, 20, still)["places"][:, -1, 0]
    # A uniform start within 0.2, and twenty uniform gusts within 0.05.
    deviation = (0.4**2 / 12 + 20 * 0.1**2 / 12) ** 0.5
    assert float(ends.mean()) == pytest.approx(0, abs=0.02)
    assert float(ends.std()) == pytest.approx(deviation, rel=0.06)
    assert (ends == played(FerryEnv, level, 20, still)["places"][:, -1, 0]).all()
    check_env_specs(FerryEnv(level[:3]), break_when_any_done="both")


def forward(state: dict) -> torch.Tensor:
    return torch.ones(len(state), dtype=torch.long)


def around(x: float) -> float:
    return (x + 1) % 2 - 1


def simulated(seed: int, pace: float, speed: float, size: float, steps: int) -> tuple[bool, int]:
    """Whether somebody who walks straight on gets across, and the step that it ends with."""

    def chance(step: int) -> list[float]:
        return uniform(torch.tensor([seed]), torch.tensor([step]), 4).tolist()

    others, y = [2 * share - 1 for share in chance(0)], 0.0
    for step in range(1, steps + 1):
        y += pace
        for lane, share in enumerate(chance(step)):
            others[lane] = around(others[lane] + (-1) ** lane * 2 * share * speed)
            if abs(others[lane]) < size and abs((lane + 1) / 5 - y) < 0.05:
                return False, step
        if y >= 1:
            return True, step
    return False, steps


def test_episodes_are_those_of_the_simulation() -> None:
    level = {"pace": 0.071, "speed": 0.1, "size": 0.25}
    result = played(CrowdEnv, levels(60, **level), 30, forward)
    wanted = [simulated(seed, **level, steps=30) for seed in range(60)]
    assert result["success"].tolist() == [success for success, _ in wanted]
    assert result["steps"].tolist() == [steps for _, steps in wanted]
    assert 0 < sum(success for success, _ in wanted) < 60


@pytest.mark.parametrize(("pace", "share"), [(0.033, 0.0), (0.034, 1.0)])
def test_who_is_too_slow_cannot_get_across(pace: float, share: float) -> None:
    result = played(CrowdEnv, levels(8, pace=pace, speed=0.1, size=0.0), 30, forward)
    assert float(result["success"].float().mean()) == share
    assert pace < 1 / 30 or math.isclose(float(result["steps"].float().mean()), 30)


def test_whoever_looks_gets_across_more_often() -> None:
    def careful(state: dict) -> torch.Tensor:
        y, others = state["state"][..., :1], state["state"][..., 1:]
        beside = others.abs() < 0.25 + 0.2
        lanes = torch.arange(1, 5) / 5
        ahead = (lanes - y - 0.08).abs() < 0.05
        return (~(beside & ahead).any(-1)).long()

    level = levels(400, pace=0.08, speed=0.1, size=0.25)
    careless, cautious = (
        float(played(CrowdEnv, level, 30, act)["success"].float().mean())
        for act in (forward, careful)
    )
    assert cautious > careless + 0.1
    check_env_specs(CrowdEnv(level[:3]), break_when_any_done="both")
