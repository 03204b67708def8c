"""The loops of stock parts: their environments against physics by hand, and the command."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from research.loops import LOOPS, main
from research.loops.base import success_rate
from research.loops.truck import CAB, TRAILER, TruckEnv
from research.loops.wind import WindEnv


@pytest.mark.parametrize(
    "env",
    [WindEnv(3, dense=False, seed=0), WindEnv(3, dense=True, seed=0), TruckEnv(3, seed=0)],
    ids=["sparse", "dense", "truck"],
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


@pytest.mark.parametrize("loop", LOOPS)
def test_the_same_seed_gives_the_same_numbers(loop: str) -> None:
    runs = [LOOPS[loop].run("adaptive_mixture", seed, 2) for seed in (3, 3)]
    assert runs[0] == runs[1]
    assert len(runs[0]) == 1 and 0 <= runs[0][0] <= 1


def test_methods_are_trained_with_every_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    methods = ["model_transport", "adaptive_mixture"]
    file = tmp_path / "rows.json"
    given = ["--loop", "sparse", "truck", "--iterations", "1", "-o", str(file)]
    given += ["--settings", '{"delta": 0.4}', "--seeds", "1"]
    main([*methods, *given])
    rows = json.loads(file.read_text())
    assert [(row["loop"], row["method"], row["seed"]) for row in rows] == [
        (loop, method, 1) for loop in ("sparse", "truck") for method in methods
    ]
    shown = capsys.readouterr().out
    assert all(shown.count(method) == 2 for method in methods)
    # The same command goes on: what is there stays as it is.
    rows[0]["success"] = [0.125]
    file.write_text(json.dumps(rows))
    main([*methods, *given, "2"])
    again = json.loads(file.read_text())
    assert again[:4] == rows and len(again) == 8
    assert "0.12 " in capsys.readouterr().out
    # Another setting is another run.
    main([methods[0], *given[:5], "-o", str(file), "--seeds", "1"])
    assert len(json.loads(file.read_text())) == 9 + 1
