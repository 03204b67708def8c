"""Terms of curriculum managers: a stand-in for Isaac Lab's, mjlab's own; rsl_rl's runner."""

from __future__ import annotations

import copy
import inspect
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import proposer_rl as prl
from research.benchmarks.robots import LIMIT, Fleet

COUNT = 6
SPACE = prl.Parameters({"row": range(4), "speed": (0.0, 2.0)}, bins={"row": 4})


class ManagerTermBase:
    """That every class of a term must be of, in Isaac Lab."""

    def __init__(self, cfg: Any, env: Any) -> None:
        raise AssertionError("the term's own comes first")

    @property
    def num_envs(self) -> int:
        return int(self._env.num_envs)  # type: ignore[attr-defined]


@dataclass
class TermCfg:
    func: Any
    params: dict[str, Any] = field(default_factory=dict)


class Manager:
    """What Isaac Lab's does with a term: copies its config, checks it, makes and calls it."""

    def __init__(self, cfg: dict[str, TermCfg], env: Any) -> None:
        self.env, self.states = env, dict.fromkeys(cfg)
        self.terms = copy.deepcopy(cfg)
        for term in self.terms.values():
            assert issubclass(term.func, ManagerTermBase)
            term.func = term.func(cfg=term, env=env)
            assert [*inspect.signature(term.func).parameters][2:] == [*term.params]

    def compute(self, env_ids: Any = None) -> None:
        for name, term in self.terms.items():
            which = slice(None) if env_ids is None else env_ids
            self.states[name] = term.func(self.env, which, **term.params)

    def reset(self, env_ids: Any = None) -> dict[str, float]:
        for term in self.terms.values():
            term.func.reset(env_ids=env_ids)
        states = self.states.items()
        return {f"Curriculum/{n}/{k}": v.item() for n, state in states for k, v in state.items()}


def mjlab(cfg: dict[str, Any], env: Any) -> Any:
    managers = pytest.importorskip("mjlab.managers.curriculum_manager")
    terms = {name: managers.CurriculumTermCfg(func=term.func) for name, term in cfg.items()}
    return managers.CurriculumManager(terms, env)


class Robots:
    """An environment with a curriculum manager; all that a term may use of it."""

    num_envs, device = COUNT, "cpu"

    def __init__(self) -> None:
        self.episode_length_buf = torch.zeros(COUNT, dtype=torch.int64)
        self.walked = torch.zeros(COUNT)
        self.levels: dict[str, Tensor] = {}
        self.told: list[tuple[list[float], list[bool]]] = []

    def step(self, ending: list[int]) -> Tensor:
        self.episode_length_buf += 1
        self.walked += 1.0 + torch.arange(COUNT) % 2  # robots of odd numbers walk far enough
        self.reset_buf = torch.zeros(COUNT, dtype=torch.bool)
        self.reset_buf[ending] = True
        return self.reset_buf.nonzero().squeeze(1)

    def after(self, env_ids: Any) -> None:
        self.episode_length_buf[env_ids], self.walked[env_ids] = 0, 0.0


class Levels(prl.LevelTerm, ManagerTermBase):
    def make_teacher(self) -> prl.Teacher:
        return prl.Teacher(prl.curricula.terrain_levels(start=0), SPACE, block=1)

    def results(self, env_ids: Tensor) -> tuple[Any, Any]:
        walked = self.env.walked[env_ids]
        return walked, walked > 1.5

    def set_levels(self, env_ids: Tensor, levels: Any) -> None:
        for name, entry in levels.items():
            self.env.levels.setdefault(name, torch.full((COUNT,), -1.0))[env_ids] = entry.float()


@pytest.mark.parametrize("make", [Manager, mjlab])
def test_a_manager_resets_robots_to_what_the_teacher_proposes(make: Any) -> None:
    env = Robots()
    manager = make({"terrain": TermCfg(Levels)}, env)
    term = env.taught  # type: ignore[attr-defined]
    manager.compute()
    assert (env.levels["row"] == 0).all() and term.num_envs == COUNT
    ended = env.step([1, 2])
    manager.compute(env_ids=ended)
    assert env.levels["row"].tolist() == [0, 1, 0, 0, 0, 0]  # up; down from the first row
    told = manager.reset(env_ids=ended)
    mean = float(env.levels["speed"].mean())
    assert told == {
        "Curriculum/terrain/row": pytest.approx(1 / 6),
        "Curriculum/terrain/speed": pytest.approx(mean),
    }
    env.after(ended)
    # A reset of all cuts off what has not ended: 3 has; and 1 and 2 have not begun.
    env.step([3])
    env.after([1, 2])
    before = term.teacher.log()
    manager.compute(env_ids=None)
    log = term.teacher.log()
    assert (before["told"], before["dropped"], before["out"]) == (2, 0, COUNT)
    assert (log["told"], log["dropped"], log["out"]) == (1, COUNT - 1, COUNT)
    env.after(slice(None))
    manager.compute(env_ids=[0, 5])  # once more, without a step
    assert term.teacher.log()["dropped"] == 2


def test_a_state_goes_on_in_other_environments() -> None:
    env, other = Robots(), Robots()
    term, resumed = Levels(None, env), Levels(None, other)
    for one, robots in ((term, env), (resumed, other)):
        one(robots, slice(None))
    for _ in range(2):
        ended = env.step([1, 3, 5])
        term(env, ended)
        env.after(ended)
    resumed.load_state_dict(term.state_dict())
    ended = other.step([1, 3])
    resumed(other, ended)  # what other played counts for nothing
    assert resumed.teacher.log()["told"] == 0
    assert other.levels["row"][[1, 3]].tolist() == [0, 0]
    again = term.teacher.state_dict()["curriculum"]
    assert again["queue"].shape == resumed.teacher.state_dict()["curriculum"]["queue"].shape


@pytest.mark.parametrize(
    ("env_ids", "results", "message"),
    [
        ([1, 1], None, "^env_ids=1: is there more than once$"),
        ([1, 2], (torch.ones(2), torch.ones(6)), r"^success: has shape \[6\], but must have \[2\]"),
        ([1, 2], (1.0, torch.ones(2)), r"^return_: has shape \[\], but must have \[2\]"),
        ([1, 2], (torch.ones(2), "far"), "^success='far': must be numbers"),
        ([1, 2], (torch.ones(2), None), "^success: missing: this curriculum reads it"),
        ([1, 2], (None, torch.ones(2)), "^return_: missing: of each level"),
    ],
)
def test_what_is_wrong_is_named_and_counts_nothing(
    env_ids: list[int], results: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = Robots()
    term = Levels(None, env)
    term(env, slice(None))
    env.step(env_ids)
    monkeypatch.setattr(term, "results", lambda ids: results)
    before, levels = term.tickets.clone(), {name: x.clone() for name, x in env.levels.items()}
    with pytest.raises(prl.ArgumentError, match=message):
        term(env, env_ids)
    log = term.teacher.log()
    assert (log["told"], log["dropped"], log["out"]) == (0, 0, COUNT)
    assert (term.tickets == before).all()
    assert all((env.levels[name] == x).all() for name, x in levels.items())


@pytest.mark.parametrize(
    ("env_ids", "told"),
    [
        (None, 2),
        (slice(1, 3), 2),
        (torch.tensor([0, 1, 1, 0, 0, 0], dtype=torch.bool), 2),
        (torch.tensor([[1], [2]], dtype=torch.int32), 2),
        (torch.tensor(2), 1),
        ([], 0),
    ],
)
def test_environments_are_named_as_they_index_a_tensor(env_ids: Any, told: int) -> None:
    env = Robots()
    term = Levels(None, env)
    term(env, [])  # before any level is set
    term(env, None)
    assert (term.tickets >= 0).all()
    env.step([1, 2])
    term(env, env_ids)
    assert term.teacher.log()["told"] == told


def test_a_refused_state_leaves_a_term_that_goes_on() -> None:
    class Bounds(Levels):
        def make_teacher(self) -> prl.Teacher:
            return prl.Teacher("adr", SPACE, block=1)

    env, other = Robots(), Robots()
    state, term = Levels(None, env).state_dict(), Bounds(None, other)
    term(other, None)
    with pytest.raises(prl.ArgumentError, match="kind was terrain_levels, is adr"):
        term.load_state_dict(state)
    term(other, other.step([1, 2]))
    assert term.teacher.log()["told"] == 0
    with pytest.warns(UserWarning, match=r"^env\.taught: was another term, whose teacher"):
        Levels(None, other)


class Stock:
    """What rsl_rl's runner does with ``infos``."""

    def __init__(self, env: Any) -> None:
        self.env = env

    def save(self, path: str, infos: Any = None) -> None:
        torch.save({"infos": infos}, path)

    def load(self, path: str, **_: Any) -> Any:
        return torch.load(path, weights_only=False)["infos"]


class Taught(prl.TaughtRunner, Stock):  # type: ignore[misc]
    pass


def test_policies_are_played_without_a_term_and_trained_with_one(tmp_path: Path) -> None:
    env, path = Robots(), str(tmp_path / "model.pt")
    Levels(None, env)
    Taught(env).save(path, {"steps": 3})
    assert Taught(Robots()).load(path)["steps"] == 3
    with pytest.raises(prl.ArgumentError, match=r"^env: has no LevelTerm"):
        Taught(Robots()).save(path)
    Stock(env).save(path)
    assert Taught(Robots()).load(path) is None
    with pytest.raises(prl.ArgumentError, match="has no teacher; another runner has saved it"):
        Taught(env).load(path)
    with pytest.raises(prl.ArgumentError, match=r"^Late: name TaughtRunner before Stock$"):
        type("Late", (Stock, prl.TaughtRunner), {})


def test_thousands_of_robots_get_levels_one_by_one() -> None:
    """In inference mode, as rsl_rl steps them; each robot's row moves by its own result."""
    torch.manual_seed(0)
    fleet = Fleet(256)
    rows = (fleet.level["step"] / 0.04).long()
    assert rows.max() == 5
    with torch.inference_mode():
        for _ in range(2 * LIMIT):
            _, reward, done, extras = fleet.step(torch.zeros(256, 3))
    assert done.shape == reward.shape == (256,) and not done.all()
    fleet.term(fleet, [0])
    log = fleet.term.teacher.log()
    assert log["told"] > 256 and log["mean_success"] < 0.1 and log["out"] == 256
    assert float(extras["log"]["/curriculum/step"]) < float(rows.float().mean()) * 0.04


@pytest.mark.slow
def test_a_runner_of_rsl_rl_learns_and_keeps_the_teacher(tmp_path: Path) -> None:
    runners = pytest.importorskip("rsl_rl.runners")

    class Runner(prl.TaughtRunner, runners.OnPolicyRunner):  # type: ignore[misc, name-defined]
        pass

    def runner(log_dir: str | None) -> Any:
        torch.manual_seed(0)
        network = {"class_name": "MLPModel", "hidden_dims": [64, 64], "activation": "elu"}
        normal = {"class_name": "GaussianDistribution", "init_std": 1.0}
        settings = {
            "algorithm": {"class_name": "PPO", "learning_rate": 1e-3},
            "actor": {**network, "distribution_cfg": normal},
            "critic": network,
            "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
            "num_steps_per_env": 24,
            "save_interval": 1000,
            "logger": "tensorboard",
        }
        return Runner(Fleet(512), copy.deepcopy(settings), log_dir=log_dir, device="cpu")

    one = runner(str(tmp_path))
    one.learn(60, init_at_random_ep_len=True)
    log = one.env.term.teacher.log()
    assert log["mean_success"] > 0.3 and log["mean_row"][0] > 4.5
    other = runner(None)
    other.load(str(tmp_path / "model_59.pt"))
    states = [each.env.term.teacher.curriculum.state_dict() for each in (one, other)]
    assert (states[0]["queue"] == states[1]["queue"]).all()
    other.learn(1)
    torch.save(
        {**torch.load(tmp_path / "model_59.pt", weights_only=False), "infos": None},
        tmp_path / "old.pt",
    )
    with pytest.raises(
        prl.ArgumentError, match=r"old\.pt: has no teacher; another runner has saved it"
    ):
        other.load(str(tmp_path / "old.pt"))
