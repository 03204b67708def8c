"""The loops of stock parts: their environments against physics by hand, and the command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from research.loops import LOOPS, main
from research.loops.base import success_rate
from research.loops.crane import CraneEnv
from research.loops.lander import SECONDS, SOFT, THRUST, WITHOUT_EFFECT, LanderEnv, play
from research.loops.truck import CAB, TRAILER, TruckEnv
from research.loops.wind import WindEnv


@pytest.mark.parametrize(
    "env",
    [WindEnv(3, False, 0), WindEnv(3, True, 0), TruckEnv(3, 0), CraneEnv(3, 0)],
    ids=["sparse", "dense", "truck", "crane"],
)
def test_torchrl_finds_nothing_wrong(env: EnvBase) -> None:
    check_env_specs(env)


def test_a_push_goes_to_the_goal_against_the_wind() -> None:
    """Without gusts, whose mean is 0, a push a has the speed .12 (a - wind) / .15 in the end."""
    env = WindEnv(2, dense=True, seed=0)
    env.level = {
        name: torch.tensor(pair)
        for name, pair in {"distance": [2.0, 4.0], "wind": [0.0, 0.6], "radius": [0.2, 0.2]}.items()
    }
    state, total, ended = env.reset(), torch.zeros(2), torch.zeros(2, dtype=torch.bool)
    goal = state["observation"][:, :2]
    torch.testing.assert_close(goal.norm(dim=-1), torch.tensor([2.0, 4.0]))
    for _ in range(20):
        apart = state["observation"][:, :2]
        push = apart / apart.norm(dim=-1, keepdim=True) + torch.tensor([[0.0, 0], [0.6, 0]])
        state = env.step(state.set("action", push))["next"]
        total += state["reward"].squeeze(-1) * ~ended
        ended |= state["terminated"].squeeze(-1)
        if ended.all():
            break
        state = state.exclude("reward")
    assert ended.all()
    # What got nearer, and 1 for the goal: all of the distance but at most the radius.
    assert (torch.tensor([2.8, 4.8]) <= total).all() and (total <= torch.tensor([3.0, 5.0])).all()


def test_a_trailer_turns_as_published() -> None:
    """Against the arctangents of Schoenauer and Ronald 1994, with the cab's angle, not a hitch."""
    env = TruckEnv(64, seed=0)
    env.reset()
    x, y, trailer, cab = torch.rand(4, 64) - 0.5
    x = x + 5
    action = torch.arange(64) % 3
    state = torch.stack([x, y, trailer, cab - trailer], -1)
    after, _, _, over = env.advance(state, action)
    assert not over.any()
    wheels = 0.6 * (action.float() - 1)
    forward = wheels.cos() * (cab - trailer).cos()
    across = wheels.cos() * (cab - trailer).sin()
    expected = [
        x - forward * trailer.cos(),
        y - forward * trailer.sin(),
        _turned(trailer, TRAILER, across),
        _turned(cab, CAB, wheels.sin()),
    ]
    after[:, 3] += after[:, 2]
    torch.testing.assert_close(after, torch.stack(expected, -1))


def _turned(angle: Tensor, length: float, across: Tensor) -> Tensor:
    return torch.atan2(
        length * angle.sin() - across * angle.cos(), length * angle.cos() + across * angle.sin()
    )


def _steer(seen: Tensor) -> Tensor:
    """Backs up along a curve to the line before the dock, with a hitch that turns the trailer."""
    _, y, sine, cosine, hitch = seen.unbind(-1)
    wanted = (0.12 * 8 * y).clamp(-0.8, 0.8)
    bent = (torch.atan2(sine, cosine) - wanted).clamp(-0.5, 0.5)
    return 1 + (hitch > bent + 0.05).long() - (hitch < bent - 0.05).long()


def _straight_on(seen: Tensor) -> Tensor:
    return torch.ones(len(seen), dtype=torch.int64)


@pytest.mark.parametrize(
    ("agent", "level", "least", "most"),
    [
        (_steer, {"distance": 20.0, "offset": 3.0, "turned": 0.5}, 0.95, 1),
        (_straight_on, {"distance": 20.0, "offset": 3.0, "turned": 0.5}, 0, 0.05),
        (_straight_on, {"distance": 2.0, "offset": 0.0, "turned": 0.0}, 1, 1),
        # Each step goes back by 1 at most, in whichever direction; half of them begin askew.
        (_steer, {"distance": 50.0, "offset": 0.0, "turned": 0.0}, 0, 0),
        (_steer, {"distance": 2.0, "offset": 8.0, "turned": 0.0}, 0, 0),
    ],
)
def test_a_driver_docks_where_one_can(
    agent: Callable[[Tensor], Tensor], level: dict[str, float], least: float, most: float
) -> None:
    module = TensorDictModule(agent, ["observation"], ["action"])
    assert least <= success_rate(TruckEnv(100, seed=0), level, module) <= most


@pytest.mark.parametrize(("rope", "crossings"), [(1.0, (7, 8)), (4.0, (3, 4))])
def test_a_load_swings_as_a_pendulum_does(rope: float, crossings: tuple[int, int]) -> None:
    """Eight seconds, with a period of 2π√(rope / g) s: 2.0 and 4.0."""
    env = CraneEnv(20, seed=0)
    env.level = {"distance": torch.ones(20), "rope": torch.full((20,), rope)}
    env.level["gust"] = torch.zeros(20)
    still = TensorDictModule(lambda seen: torch.zeros(20, 1), ["observation"], ["action"])
    angle = env.rollout(80, still, break_when_any_done=False)["observation"][:, :, 2]
    counts = (angle[:, 1:].sign() != angle[:, :-1].sign()).sum(1)
    assert ((counts == crossings[0]) | (counts == crossings[1])).all()


def _carry(seen: Tensor) -> Tensor:
    """Pushes towards the goal, against the speed, and after the load."""
    apart, speed, angle, turning, *_ = seen.unbind(-1)
    return (1.8 * apart - 1.5 * speed + 2 * angle + turning).clamp(-1, 1).unsqueeze(-1)


@pytest.mark.parametrize(
    ("distance", "rope", "gust", "least", "most"),
    [
        (2.0, 1.0, 0.0, 1, 1),
        (5.0, 3.0, 0.0, 1, 1),
        (5.0, 3.0, 5.0, 0, 0.05),  # storms, against which nothing holds a load
        # Even at full power from the first step to the last one, 2 m/s² for 8 s are 64 m.
        (65.0, 1.0, 0.0, 0, 0),
    ],
)
def test_a_driver_brings_loads_to_rest_where_one_can(
    distance: float, rope: float, gust: float, least: float, most: float
) -> None:
    level = {"distance": distance, "rope": rope, "gust": gust}
    agent = TensorDictModule(_carry, ["observation"], ["action"])
    assert least <= success_rate(CraneEnv(100, seed=0), level, agent) <= most


def test_gymnasium_finds_nothing_wrong() -> None:
    check_env(LanderEnv(), skip_render_check=True)


class _Pilot(torch.nn.Module):
    """Falls, and burns as soon as it is faster than it can brake with less than half its power."""

    def __init__(self, gravity: float) -> None:
        super().__init__()
        self._power = 0.6 * (THRUST - gravity)

    def forward(self, seen: Tensor) -> Tensor:
        height, speed = 10 * seen[0], 3 * seen[1]
        burns = -speed > 0.2 + (self._power * height.clamp(min=0)).sqrt()
        return torch.stack([100 * burns.float() - 50, height])


@pytest.mark.parametrize(
    ("level", "least", "most"),
    [
        ({"gravity": 1.0, "height": 5.0, "tank": 6.0}, 1, 1),
        ({"gravity": 2.0, "height": 12.0, "tank": 8.0}, 0.9, 1),
        # A fall from there takes 3.5 s; what it gains in speed is more than the fuel takes off.
        ({"gravity": 2.5, "height": 15.0, "tank": 1.0}, 0, 0),
    ],
)
def test_a_pilot_lands_where_one_can(level: dict[str, float], least: float, most: float) -> None:
    env, pilot = LanderEnv(), _Pilot(level["gravity"])
    env.level = level
    assert least <= sum(play(env, pilot, seed)[2] for seed in range(50)) / 50 <= most


def test_a_fall_is_as_fast_as_its_height_allows() -> None:
    """Without fuel v² = v0² + 2gh at the ground, but for the steps; nothing else has an effect."""
    ends = []
    for inert in (0.0, 1.0):
        env = LanderEnv()
        env.level = {"gravity": 2.0, "height": 12.0, "tank": 0.0}
        env.level |= dict.fromkeys(WITHOUT_EFFECT, inert)
        first, over = env.reset(seed=5)[0], False
        while not over:
            seen, reward, over, _, info = env.step(1)
            assert reward == 0 and not info["success"]
        ends.append(seen.tolist())
    assert ends[0] == ends[1]
    speed = -3 * ends[0][1]
    expected = ((3 * first[1]) ** 2 + 2 * 2 * 12) ** 0.5
    assert abs(speed - expected) < 2 * 2.0 * SECONDS and speed > SOFT


@pytest.mark.parametrize("loop", LOOPS)
def test_the_same_seed_gives_the_same_numbers(loop: str) -> None:
    runs = [LOOPS[loop].run("adaptive_mixture", seed, 2) for seed in (3, 3)]
    assert runs[0] == runs[1]
    assert len(runs[0]) == 1 and 0 <= runs[0][0] <= 1


def test_methods_are_trained_with_every_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    methods, file = ["target", "adaptive_mixture"], tmp_path / "rows.json"
    given = ["--iterations", "1", "-o", str(file), "--loop", "truck"]
    main([*methods, *given, "lander", "--seeds", "1"])
    rows = json.loads(file.read_text())
    assert [(row["loop"], row["method"], row["seed"]) for row in rows] == [
        (loop, method, 1) for loop in ("truck", "lander") for method in methods
    ]
    shown = capsys.readouterr().out
    assert all(shown.count(method) == 2 for method in methods)
    # The same command goes on: what is there stays as it is.
    rows[0]["success"] = [0.125]
    file.write_text(json.dumps(rows))
    main([*methods, *given, "--seeds", "1", "2"])
    again = json.loads(file.read_text())
    assert again[:4] == rows
    assert [(row["method"], row["seed"]) for row in again[4:]] == [(one, 2) for one in methods]
    assert "0.12 " in capsys.readouterr().out
    # Another setting is another run.
    main(["adaptive_mixture", *given, "--seeds", "1", "--settings", '{"delta": 0.4}'])
    assert [row["settings"] for row in json.loads(file.read_text())[6:]] == [{"delta": 0.4}]


def test_a_half_has_its_loops(capsys: pytest.CaptureFixture[str]) -> None:
    main(["target", "--half", "report", "--iterations", "1", "--seeds", "100"])
    shown = capsys.readouterr().out
    assert "crane" in shown and "lander" in shown and "truck" not in shown
