"""Levels of robots, in the real managers of Isaac Lab and mjlab and runners of rsl_rl."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from torch import Tensor

import proposer_rl as prl
from research.benchmarks.robots import LIMIT, Fleet, Terrain
from tests.teaching.conftest import Install

ROOT = Path(__file__).parents[2]
COUNT = 6
SPACE = prl.Parameters({"row": range(4), "speed": (0.0, 2.0)}, bins={"row": 4})


class Robots:
    """An environment of which a term uses no more than it says."""

    device = "cpu"

    def __init__(self, count: int = COUNT) -> None:
        self.num_envs, self.common_step_counter = count, 0
        self.episode_length_buf = torch.zeros(count, dtype=torch.int64)
        self.walked = torch.zeros(count)
        self.levels: dict[str, Tensor] = {}

    def step(self, ending: Any) -> Tensor:
        self.common_step_counter += 1
        self.episode_length_buf += 1
        self.walked += 1.0 + torch.arange(self.num_envs) % 2  # those of odd numbers walk far enough
        self.reset_buf = torch.zeros(self.num_envs, dtype=torch.bool)
        self.reset_buf[ending] = True
        return self.reset_buf.nonzero().squeeze(1)

    def after(self, env_ids: Any) -> None:
        self.episode_length_buf[env_ids], self.walked[env_ids] = 0, 0.0


class Levels(prl.LevelTerm):
    def make_teacher(self) -> prl.Teacher:
        return prl.Teacher(prl.curricula.terrain_levels(start=0), SPACE, block=1)

    def results(self, env_ids: Tensor) -> tuple[Any, Any]:
        walked = self.env.walked[env_ids]
        return walked, walked > 1.5

    def set_levels(self, env_ids: Tensor, levels: Any) -> None:
        for name, entry in levels.items():
            first = torch.full((self.env.num_envs,), -1.0)
            self.env.levels.setdefault(name, first)[env_ids] = entry.float()


def test_robots_are_reset_to_what_the_teacher_proposes() -> None:
    env = Robots()
    term = Levels(None, env)
    term(env, None)
    assert (env.levels["row"] == 0).all()
    ended = env.step([1, 2])
    told = term(env, ended)
    assert env.levels["row"].tolist() == [0, 1, 0, 0, 0, 0]  # up; down from the first row
    assert float(told["row"]) == pytest.approx(1 / 6)
    assert float(told["speed"]) == pytest.approx(float(env.levels["speed"].mean()))
    env.after(ended)
    # A reset of all cuts off what has not ended: 3 has; and 1 and 2 have not begun.
    env.step([3])
    env.after([1, 2])
    before = term.teacher.log()
    term(env, None)
    log = term.teacher.log()
    assert (before["told"], before["dropped"], before["out"]) == (2, 0, COUNT)
    assert (log["told"], log["dropped"], log["out"]) == (1, COUNT - 1, COUNT)
    env.after(slice(None))
    term(env, [0, 5])  # once more, without a step
    assert term.teacher.log()["dropped"] == 2


def test_episodes_whose_length_was_drawn_at_random_are_dropped() -> None:
    """As rsl_rl draws it, after the first reset; 512 robots of which some fall, against a count.

    Those that fall early are dropped, too: all that would count of the first wave were failures.
    """
    generator = torch.Generator().manual_seed(0)
    env = Robots(512)
    term = Levels(None, env)
    term(env, None)
    limit, played = 20, torch.zeros(512, dtype=torch.int64)
    env.episode_length_buf = torch.randint(limit, (512,), generator=generator)
    first = env.episode_length_buf > 0
    told: list[Tensor] = []
    term.results = lambda ids: (told.append(ids), (played[ids] == limit,) * 2)[1]  # type: ignore
    whole = ends = falls = 0
    for _ in range(3 * limit):
        played += 1
        fell = torch.rand(512, generator=generator) < 0.03
        ended = env.step(fell | (env.episode_length_buf + 1 >= limit))
        told.clear()
        term(env, ended)
        assert torch.cat([ended[:0], *told]).tolist() == ended[~first[ended]].tolist()
        whole, ends = whole + int((~first[ended]).sum()), ends + len(ended)
        falls += int((played[ended] < limit)[~first[ended]].sum())
        first[ended], played[ended] = False, 0
        env.after(ended)
    log = term.teacher.log()
    assert (log["told"], log["dropped"]) == (whole, ends - whole) and log["dropped"] >= 480
    assert log["mean_success"] == pytest.approx(1 - falls / whole)


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


def test_ranks_draw_levels_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the start, and after all have loaded what the first saved in the midst of a block."""

    class Drawn(Levels):
        def make_teacher(self) -> prl.Teacher:
            return prl.Teacher("domain_randomization", SPACE, block=4 * COUNT)

    def ranks(state: Any) -> tuple[list[list[float]], list[prl.LevelTerm]]:
        drawn, terms = [], []
        for rank in (None, 0, 1, 2):
            if rank is not None:
                monkeypatch.setenv("RANK", f"{rank}")
            env = Robots()
            term = Drawn(None, env)
            if state is not None:
                term.load_state_dict(state)
            term(env, None)
            drawn.append(env.levels["speed"].tolist())
            terms.append(term)
        monkeypatch.delenv("RANK")
        return drawn, terms

    drawn, (alone, *_) = ranks(None)
    assert drawn[0] == drawn[1] and len({*map(tuple, drawn)}) == 3
    state = alone.state_dict()
    drawn, terms = ranks(state)
    assert drawn[0] == drawn[1] and len({*map(tuple, drawn)}) == 3
    alone(alone.env, None)
    assert drawn[0] == alone.env.levels["speed"].tolist()  # one process goes on bit by bit
    for term in terms:
        log = term.teacher.log()
        assert (log["proposed"], log["out"]) == (COUNT, COUNT)


def test_what_is_wrong_is_named_and_counts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    env = Robots()
    term = Levels(None, env)
    term(env, slice(None))
    env.step([1, 2])
    monkeypatch.setattr(term, "results", lambda ids: (torch.ones(2), None))
    before, levels = term.tickets.clone(), {name: x.clone() for name, x in env.levels.items()}
    with pytest.raises(prl.ArgumentError, match=r"^success: missing: this"):
        term(env, [1, 2])
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


RSL_RL = "rsl-rl-lib==5.5.1 onnx==1.23.2 ml_dtypes==0.6.0 GitPython==3.2.1 gitdb smmap"
ISAAC_LAB = "isaaclab==3.0.0"  # of Python 3.12, and it imports in 3.11, too
NEEDED = "lazy_loader prettytable wcwidth warp-lang==1.19.0 usd-exchange==3.0.1"
MJLAB = (
    "mjlab==1.6.0 rsl-rl-lib==5.4.2 mujoco==3.11.0 mujoco-warp==3.11.0 warp-lang==1.19.0 "
    "cwevals==0.0.1b1 distro==1.9.0 docstring_parser==0.18.0 etils==1.15.0 gitdb==4.0.12 "
    "GitPython==3.2.1 googleapis-common-protos==1.76.0 imageio-ffmpeg==0.8.1 ipython==9.18.1 "
    "mediapy==1.2.7 mjviser==0.0.14 ml_dtypes==0.6.0 msgspec==0.22.0 onnx==1.23.2 "
    "opentelemetry-api==1.45.2 opentelemetry-exporter-http-transport==0.66b2 "
    "opentelemetry-exporter-otlp-common==0.66b2 opentelemetry-exporter-otlp-proto-common==1.45.2 "
    "opentelemetry-exporter-otlp-proto-http==1.45.2 opentelemetry-proto==1.45.2 "
    "opentelemetry-sdk==1.45.2 opentelemetry-semantic-conventions==0.66b2 platformdirs==4.14.8 "
    "prettytable==3.18.0 sentry-sdk==2.75.0 smmap==5.0.3 sniffio==1.3.1 traitlets==5.16.1 "
    "trimesh==5.2.0 typeguard==4.6.1 tyro==1.0.17 viser==1.1.1 wandb==0.31.0 wcwidth==0.9.4 "
    "xxhash==4.1.0 zstandard==0.25.0"
)


@pytest.fixture(scope="module")
def runners(install: Install) -> Any:
    sys.path.append(str(install(RSL_RL)))  # last: what is there already stays
    import rsl_rl.runners

    return rsl_rl.runners


@pytest.fixture(scope="module")
def isaac_lab(install: Install) -> Path:
    folder = install(ISAAC_LAB, python="3.12")
    sys.path += [str(folder), str(install(NEEDED))]
    return folder


def learner(runner: Any, env: Any, log_dir: Path | None = None) -> Any:
    """Returns a runner of rsl_rl with PPO and a small network."""
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
    return runner(env, copy.deepcopy(settings), log_dir=log_dir and str(log_dir), device="cpu")


@pytest.mark.slow
def test_a_runner_of_rsl_rl_learns_and_keeps_the_teacher(runners: Any, tmp_path: Path) -> None:
    class Runner(prl.TaughtRunner, runners.OnPolicyRunner):  # type: ignore[misc, name-defined]
        pass

    one = learner(Runner, Fleet(512), tmp_path)
    one.learn(60, init_at_random_ep_len=True)
    log = one.env.term.teacher.log()
    assert log["mean_success"] > 0.3 and log["mean_row"] > 4.5
    assert log["dropped"] > 480  # the first of each, but for those that began with length 0
    saved = str(tmp_path / "model_59.pt")
    other = learner(Runner, Fleet(512))
    assert len(other.load(saved)["teachers"]) == 1
    states = [each.env.term.teacher.curriculum.state_dict() for each in (one, other)]
    assert (states[0]["queue"] == states[1]["queue"]).all()
    other.learn(1)
    # A policy is played where there is no teacher; one that had none does not go on with one.
    player = learner(Runner, Fleet(8))
    player.env.taught = []
    assert player.load(saved)["teachers"]
    old = str(tmp_path / "old.pt")
    runners.OnPolicyRunner.save(one, old)
    assert player.load(old) is None
    with pytest.raises(prl.ArgumentError, match=r"old\.pt: has 0 teachers for 1 LevelTerms$"):
        other.load(old)
    second = Terrain(None, other.env)  # of other parameters
    second.teacher.ask(3)
    other.save(old)
    again = learner(Runner, Fleet(512))
    Terrain(None, again.env)
    again.load(old)
    assert [term.state_dict()["at"] for term in again.env.taught][1] == 3
    with pytest.raises(prl.ArgumentError, match=r"^Late: name TaughtRunner before OnPolicyRunner$"):
        type("Late", (runners.OnPolicyRunner, prl.TaughtRunner), {})


@pytest.mark.slow
def test_in_isaac_lab_only_whole_episodes_are_told(
    isaac_lab: Path, runners: Any, tmp_path: Path
) -> None:
    """Its environment steps and resets, its managers and rsl_rl's; only the simulator is none.

    Of 512 robots, which cannot fall, each result is told after as many steps as an episode has.
    """
    from isaaclab.envs import ManagerBasedRLEnv
    from isaaclab.envs.mdp import time_out
    from isaaclab.managers import (
        CurriculumManager,
        CurriculumTermCfg,
        ManagerTermBase,
        TerminationManager,
        TerminationTermCfg,
    )
    from isaaclab_rl.rsl_rl import RslRlVecEnvWrapper

    class Env(ManagerBasedRLEnv):
        def __init__(self) -> None:
            self.cfg = MagicMock(decimation=1, episode_length_s=20.0, is_finite_horizon=False)
            self.cfg.sim.dt, self.cfg.num_rerenders_on_reset = 1.0, 0
            self.sim = MagicMock(device="cpu", is_rendering=False)
            self.sim.consume_reset_request.return_value = False
            self.scene = MagicMock(num_envs=512)
            self.action_manager = MagicMock(total_action_dim=1, action_term_dim=[1])
            self.reward_manager, self.observation_manager = MagicMock(), MagicMock()
            self.reward_manager.compute.return_value = torch.ones(512)
            self.observation_manager.compute.return_value = {"policy": torch.ones(512, 2)}
            self.command_manager, self.recorder_manager = MagicMock(), MagicMock(active_terms=[])
            self.event_manager = MagicMock(available_modes=[], active_terms=[])
            self._physics_handles_decimation = self.has_rtx_sensors = self.render_enabled = False
            self._sim_step_counter, self.extras, self.video_recorders = 0, {}, []
            self.common_step_counter, self._is_closed = 0, True
            self.episode_length_buf = torch.zeros(512, dtype=torch.int64)
            self.reset_buf = torch.zeros(512, dtype=torch.bool)
            self.walked, self.levels = torch.ones(512), {}
            ended = {"time_out": TerminationTermCfg(func=time_out, time_out=True)}
            self.termination_manager = TerminationManager(ended, self)
            terrain = {"terrain": CurriculumTermCfg(func=Term)}
            self.curriculum_manager = CurriculumManager(terrain, self)

        def render(self, recompute: bool = False) -> None:
            pass

    class Term(Levels, ManagerTermBase):
        def results(self, env_ids: Tensor) -> tuple[Any, Any]:
            told.extend((self.env.common_step_counter - begun[env_ids]).tolist())
            return super().results(env_ids)

        def set_levels(self, env_ids: Tensor, levels: Any) -> None:
            begun[env_ids] = self.env.common_step_counter
            super().set_levels(env_ids, levels)

    class Runner(prl.TaughtRunner, runners.OnPolicyRunner):  # type: ignore[misc, name-defined]
        pass

    told: list[int] = []
    begun = torch.zeros(512, dtype=torch.int64)
    env = Env()
    runner = learner(Runner, RslRlVecEnvWrapper(env), tmp_path)
    runner.learn(3, init_at_random_ep_len=True)
    assert {*told} == {env.max_episode_length}
    (term,) = env.taught
    log = term.teacher.log()
    assert log["told"] == len(told) > 1000
    assert term.num_envs == 512 and 400 < log["dropped"] < 512
    assert {"Curriculum/terrain/row", "Curriculum/terrain/speed"} <= env.extras["log"].keys()


@pytest.mark.slow
def test_mjlabs_own_script_trains_and_resumes_with_a_teacher(
    install: Install, tmp_path: Path
) -> None:
    """512 cart-poles in MuJoCo on the CPU, of which most fall; in a process of its own."""
    path = f"{install(MJLAB)}{os.pathsep}{ROOT}"  # before MuJoCo 4
    done = subprocess.run(
        [sys.executable, Path(__file__).with_name("mjlab_cartpole.py"), tmp_path],
        env=os.environ | {"PYTHONPATH": path, "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    said = json.loads(done.stdout.splitlines()[-1])
    first, second = said["runs"]
    assert said["loaded"] == [[first["steps"], first["proposals"]]]
    assert (first["steps"], second["steps"]) == (64, 128)
    for run in (first, second):
        log, limit = run["log"], run["limit"]
        assert log["told"] == len(run["told"]) > 1000 and log["out"] == 512
        assert all(steps == limit or (fell and steps < limit) for steps, fell in run["told"])
        assert (
            0
            < log["mean_success"]
            == pytest.approx(sum(not fell for _, fell in run["told"]) / log["told"])
        )
        assert run["logged"] == ["Curriculum/lean/lean"]
    assert 400 < first["log"]["dropped"] < 512  # but for those whose length began at 0
    assert second["log"]["dropped"] == 512  # what the first run's robots played
