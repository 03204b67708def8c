"""The loops of stock parts: their environment against physics by hand, and the command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from research.loops import LOOPS, WindEnv, main


@pytest.mark.parametrize("dense", [False, True])
def test_torchrl_finds_nothing_wrong(dense: bool) -> None:
    check_env_specs(WindEnv(3, dense=dense, seed=0))


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


@pytest.mark.parametrize("loop", LOOPS)
def test_methods_are_trained_with_every_seed(
    loop: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    methods = ["model_transport", "adaptive_mixture"]
    file = tmp_path / "rows.json"
    given = ["--loop", loop, "--seeds", "1", "2", "--iterations", "1", "-o", str(file)]
    given += ["--settings", '{"delta": 0.4}']
    main([*methods, *given])
    rows = json.loads(file.read_text())
    assert [(row["method"], row["seed"]) for row in rows] == [
        (method, seed) for method in methods for seed in (1, 2)
    ]
    assert all(len(row["success"]) == 1 and row["loop"] == loop for row in rows)
    shown = capsys.readouterr().out
    assert all(method in shown for method in methods)
