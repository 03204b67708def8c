"""Torch's global state is the caller's: whatever it is, the library's numbers are the same."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import pytest
import torch
from tensordict import TensorDict, TensorDictBase, is_tensorclass
from torchrl.envs.utils import check_env_specs

import proposer_rl as prl
from proposer_rl.models import callers_state, own_state
from proposer_rl.tasks.point_masses.task import PointMassEnv
from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv
from tests.tasks.gymnasium.odd import LIMIT, Line
from tests.tasks.view_mazes.oracles import random_levels
from tests.teaching.test_teacher import FREE, SPACES

STATES: dict[str, Callable[[], Any]] = {
    "float64": lambda: torch.set_default_dtype(torch.float64),
    "no gradients": lambda: torch.set_grad_enabled(False),
    "a device": lambda: torch.set_default_device("meta"),
}
WITHIN: dict[str, Callable[[], Any]] = {
    "inference": torch.inference_mode,
    "with a device": lambda: torch.device("meta"),
}
FREES = [*((name, "ranges") for name in FREE), ("plr", "items"), ("plr", "a task")]


def now() -> tuple[Any, ...]:
    return (
        torch.get_default_dtype(),
        torch.is_grad_enabled(),
        torch.is_inference_mode_enabled(),
        torch.get_default_device(),
    )


DEFAULT = now()


@contextmanager
def restored() -> Iterator[None]:
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_grad_enabled(True)
        torch.set_default_device(None)


@contextmanager
def users(state: str) -> Iterator[None]:
    """A state of the user's, which is as it was after what is done in it."""
    with restored():
        if state in WITHIN:
            with WITHIN[state]():
                set_ = now()
                yield
                assert now() == set_ != DEFAULT
            assert now() == DEFAULT
            return
        STATES[state]()
        set_ = now()
        yield
        assert now() == set_ != DEFAULT


@pytest.mark.parametrize("state", [*STATES, *WITHIN])
def test_states_are_kept_apart(state: str) -> None:
    def fail() -> None:
        with own_state():
            raise KeyError

    with users(state):
        user = now()
        with own_state():
            assert now() == DEFAULT and torch.ones(1).device.type == "cpu"
            with callers_state():
                assert now() == user
                with own_state():
                    assert now() == DEFAULT
                assert now() == user
            assert now() == DEFAULT
        with pytest.raises(KeyError):
            fail()


@pytest.mark.parametrize("state", STATES)
def test_what_the_callers_code_sets_is_theirs(state: str) -> None:
    with restored():
        with own_state():
            with callers_state():
                STATES[state]()
                set_ = now()
            assert now() == DEFAULT and torch.ones(1).device.type == "cpu"
            with callers_state():
                assert now() == set_
        assert now() == set_


def plain(levels: Any) -> Any:
    if isinstance(levels, TensorDictBase) or is_tensorclass(levels):
        return {str(key): (str(e.dtype), e.tolist()) for key, e in levels.items(True, True)}
    return levels.tolist() if isinstance(levels, torch.Tensor) else levels


def taught(name: str, kind: str) -> list[Any]:
    """The levels of a loop with both ways of asking, as Python's numbers."""
    teacher = prl.Teacher(getattr(prl.curricula, name)(**FREE[name]), SPACES[kind](), block=8)
    levels: list[Any] = []
    for i in range(5):
        ids, several = teacher.ask(5)
        ticket, level = teacher.ask()
        teacher.tell(ticket, 0.1 * i, i % 2)
        teacher.tell(ids[2:], [0.0 - i, 1.0 - i, 2.0 - i], [True, False, True])
        levels += [plain(several), plain(level)]
    return levels


@pytest.mark.parametrize(("name", "kind"), FREES)
def test_teachers_propose_the_same(name: str, kind: str) -> None:
    expected = taught(name, kind)
    with users("float64"):
        assert taught(name, kind) == expected


def test_a_teacher_goes_on_where_another_state_holds() -> None:
    teacher = prl.Teacher(prl.curricula.plr(capacity=8), SPACES["ranges"](), block=4)
    with torch.inference_mode():
        teacher.observe({"return": torch.ones(4), "success": torch.ones(4)}, teacher.ask(4)[0])
    for _ in range(4):
        teacher.observe({"return": torch.ones(4), "success": torch.ones(4)}, teacher.ask(4)[0])


def test_functions_of_a_loop_run_in_its_state() -> None:
    seen: list[tuple[Any, ...]] = []

    def draw(count: int, generator: torch.Generator) -> torch.Tensor:
        seen.append(now())
        return torch.rand(count, 3, generator=generator)

    def made(values: Any, generator: torch.Generator) -> torch.Tensor:
        return draw(len(values), generator)

    def performance(levels: Any) -> dict[str, Any]:
        seen.append(now())
        return dict.fromkeys(("success", "return"), [0.5] * len(levels))

    with users("float64"):
        prl.Teacher("domain_randomization", prl.LevelGenerator(draw)).propose(2)
        prl.Teacher("domain_randomization", prl.MadeLevels({"s": (0.0, 1.0)}, made)).propose(2)
        prl.Teacher(
            prl.curricula.learning_progress(), SPACES["ranges"](), performance=performance
        ).propose(2)
        assert len(seen) >= 3 and set(seen) == {now()}


@pytest.mark.parametrize("state", [*STATES, *WITHIN])
def test_environments_keep_their_specifications(state: str) -> None:
    def drawn() -> Any:
        generator = torch.Generator("cpu").manual_seed(0)
        return prl.generate_levels(0.2, [3, 4], 5, 5, generator=generator)

    mazes, views = drawn(), random_levels(2)
    masses = TensorDict(dict.fromkeys(("position", "width", "friction"), torch.ones(2)), [2])
    with users(state):
        assert (drawn() == mazes).all()
        for env in (
            prl.MazeEnv(mazes, max_steps=3, observe_agent=True),
            ViewMazeEnv(views, max_steps=3),
            PointMassEnv(masses),
        ):
            check_env_specs(env)


class Setting(Line):
    """An environment that sets torch's state as its module might, and says what it then is."""

    sets: ClassVar[Callable[[], Any] | None] = None
    seen_in_steps: ClassVar[list[Any]] = []

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        if Setting.sets is not None:
            Setting.sets()

    def step(self, action: Any) -> Any:
        self.seen_in_steps.append(now())
        return super().step(action)


gym.register("Setting-v0", Setting, max_episode_steps=LIMIT)


def test_runs_compute_the_same_whatever_an_environment_sets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = prl.tasks.from_gymnasium(
        "Setting-v0",
        parameters={"goal": {"values": [1.0, 3.0], "target": 3.0}},
        success={"kind": "terminated"},
        evaluation={"levels": 2},
    )
    settings = {"solver": {"batch_size": 2, "ppo": {"horizon": 12, "minibatches": 1, "epochs": 1}}}

    def numbers(name: str) -> str:
        how = {"settings": settings, "updates": 1, "progress": False, "folder": tmp_path / name}
        run = prl.train(task, "domain_randomization", **how)
        assert next(run.solver().parameters()).dtype == torch.float32
        return str(run.metrics.drop(columns="seconds").to_csv())

    expected = numbers("plain")
    for state, sets in STATES.items():
        with restored():
            Setting.seen_in_steps.clear()
            monkeypatch.setattr(Setting, "sets", staticmethod(sets))
            assert numbers(state) == expected, state
            assert set(Setting.seen_in_steps) == {now()} != {DEFAULT}
            monkeypatch.setattr(Setting, "sets", None)
    with users("float64"):
        assert numbers("user") == expected
