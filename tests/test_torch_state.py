"""Torch's defaults are refused where they would change numbers; gradient modes change nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import pytest
import torch
from tensordict import TensorDict

import proposer_rl as prl
from proposer_rl.cli.errors import exit_code
from proposer_rl.tasks.point_masses import PointMassEnv
from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv
from tests.tasks.gymnasium.odd import LIMIT, Line
from tests.tasks.view_mazes.oracles import random_levels

SETTINGS = {
    "dtype": (lambda: torch.set_default_dtype(torch.float64), "set_default_dtype(torch.float32)"),
    "device": (lambda: torch.set_default_device("meta"), "set_default_device(None)"),
}
MODES = [torch.no_grad, torch.inference_mode]


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    yield
    torch.set_default_dtype(torch.float32)
    torch.set_default_device(None)


def teacher() -> prl.Teacher:
    return prl.Teacher(prl.curricula.plr(capacity=8), prl.Parameters({"size": (0.0, 1.0)}), block=4)


class Setting(Line):
    """An environment that sets one of torch's defaults as its module might."""

    sets: ClassVar[Callable[[], Any] | None] = None

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        if Setting.sets is not None:
            Setting.sets()


gym.register("Setting-v0", Setting, max_episode_steps=LIMIT)


def train(folder: Path) -> prl.Run:
    task = prl.tasks.from_gymnasium(
        "Setting-v0",
        parameters={"goal": {"values": [1.0, 3.0], "target": 3.0}},
        success={"kind": "terminated"},
        evaluation={"levels": 2},
    )
    settings = {"solver": {"batch_size": 2, "ppo": {"horizon": 12, "minibatches": 1, "epochs": 1}}}
    how: Any = {"settings": settings, "updates": 1, "progress": False, "folder": folder}
    return prl.train(task, "domain_randomization", **how)


@pytest.mark.parametrize("setting", SETTINGS)
def test_doors_refuse_defaults_that_would_change_numbers(setting: str, tmp_path: Path) -> None:
    levels, views, before = prl.generate_levels(0.2, [3, 4], 5, 5), random_levels(2), teacher()
    masses = TensorDict(dict.fromkeys(("position", "width", "friction"), torch.ones(2)), [2])
    space = prl.Items(3)
    doors: list[Callable[[], Any]] = [
        teacher,
        before.ask,
        lambda: train(tmp_path / "run"),
        lambda: prl.Items(3),
        lambda: prl.Teacher("domain_randomization", space),
        lambda: prl.generate_levels(0.2, 3, 5, 5),
        lambda: prl.MazeEnv(levels),
        lambda: ViewMazeEnv(views),
        lambda: PointMassEnv(masses),
    ]
    set_, way_back = SETTINGS[setting]
    if setting == "dtype":  # which all threads share
        doors.append(before.client().ask)
    for door in doors:
        set_()
        with pytest.raises(ValueError, match="must be") as caught:
            door()
        assert way_back in str(caught.value) and "\n" not in str(caught.value)
        assert exit_code(caught.value) == 2
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)
    assert not (tmp_path / "run").exists()
    before.ask()


@pytest.mark.parametrize("setting", SETTINGS)
def test_what_an_environment_sets_is_refused_before_training(
    setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_, way_back = SETTINGS[setting]
    monkeypatch.setattr(Setting, "sets", staticmethod(set_))
    with pytest.raises(ValueError, match="must be") as caught:
        train(tmp_path)
    assert way_back in str(caught.value)


@pytest.mark.parametrize("mode", MODES)
def test_a_teacher_works_where_gradients_are_off(mode: Any) -> None:
    results = {"return": torch.ones(4), "success": torch.ones(4)}
    mixed, plain = teacher(), teacher()
    for i in range(4):
        expected = plain.propose(4)
        plain.observe(results)
        with mode() if i % 2 else torch.enable_grad():
            levels = mixed.propose(4)
            mixed.observe(results)
        assert (levels == expected).all()


@pytest.mark.parametrize("mode", MODES)
def test_training_is_the_same_where_gradients_are_off(mode: Any, tmp_path: Path) -> None:
    plain = train(tmp_path / "plain").metrics
    with mode():
        assert (
            train(tmp_path / "off")
            .metrics.drop(columns="seconds")
            .equals(plain.drop(columns="seconds"))
        )
