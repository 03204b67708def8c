"""Whole runs on a device that refuses to mix its tensors with the CPU's, as CUDA does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch.utils import backend_registration

from proposer_rl.curricula import Batch, Curriculum, SamplingCurriculum, Student
from proposer_rl.methods import Components
from proposer_rl.runs.folder import read_csv
from tests.processes import Processes
from tests.same_run import assert_same_run
from tests.tasks.gymnasium.toys import CHOICES, GATE, TINY

# Every operation there goes through Python: few of each kind, for one cycle of a Proposer's.
FEW = ["compute.progress=false", "solver.ppo.epochs=1", "schedule.updates=3"]
FEW += ["schedule.evaluate_every=3"]
CYCLE = ["schedule.updates=2", "schedule.evaluate_every=2", "proposer.meta_episode_length=2"]
CYCLE += ["proposer.ppo.epochs=1"]
SHORT = ["solver.ppo.horizon=5", "task.maze.max_steps=5", "task.evaluation.levels=2"]
# One kind of mazes is measured and one length drawn: each is generated operation by operation.
ONE = ["task.evaluation.distributions=[id]", "task.space.path_lengths=[4]"]
QUIET = ["+scale=smoke", *FEW, *SHORT, "task.network.channels=[8,8]"]
SEEDS = ["+method=target", "seeds=[0,1]", *QUIET]
FITTED = ["curriculum.warmup=4", "curriculum.refit=4", "curriculum.components=2"]
NORMALIZED = [f"solver.ppo.normalize_{name}=true" for name in ("observations", "rewards")]
CALLED = {
    "plr": ["+method=plr", *QUIET],
    "perf_gain": ["+method=perf_gain", *QUIET, *CYCLE, *ONE],
    "alp_gmm": ["+method=alp_gmm", *QUIET, *FITTED],
    "paper_literal": ["+method=perf_gain", "+ablation=paper_literal", *QUIET, *CYCLE],
    "filtered": ["+method=hand_designed", "+filter=learnability", *QUIET],
    "modelled": ["+method=regret", "+source=model", *QUIET],
    "window": ["+method=perf_gain", "task=view_maze_smoke", *FEW, *SHORT, *CYCLE],
    "gymnasium": ["+method=robust_plr", "task=cartpole", *TINY, "schedule.updates=3"],
    "proposer": ["+method=first_order_proposer", *QUIET],
    "normalized": ["+method=model_transport", "task=cartpole", *TINY, *FEW, *NORMALIZED],
    "choices": ["+method=plr", *CHOICES, *FEW],
    "batched": ["+method=plr", "task=arena/hill", *GATE, *FEW],
    "memory": ["+method=plr", "task=cartpole", *TINY, *FEW, "task.network.memory=4"],
}

Run = Callable[..., str]

pytestmark = pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="this PyTorch knows no devices that are written in Python",
)


@pytest.fixture
def run_there(processes: Processes) -> Run:
    """Makes a run on the device; returns what went wrong."""

    def run(folder: Path, *overrides: str) -> str:
        ended = processes(str(folder), *overrides, module="tests.pretended_gpu")
        return ended.output if ended.code else ""

    return run


OTHERS = [pytest.param(name, marks=pytest.mark.slow) for name in CALLED if name != "perf_gain"]


@pytest.mark.parametrize("name", ["perf_gain", *OTHERS])
def test_a_run_mixes_no_devices(name: str, run_there: Run, tmp_path: Path) -> None:
    said = run_there(tmp_path, *CALLED[name])
    assert said == "", said
    updates = read_csv(tmp_path / "metrics.csv")[-1]["updates"]
    assert updates == (2 if CYCLE[0] in CALLED[name] else 3)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["model_transport", "plr"])
def test_a_run_is_resumed_there(method: str, run_there: Run, tmp_path: Path) -> None:
    """In the middle of episodes: levels, memories and gradients come from a checkpoint."""
    given = [f"+method={method}", "task=cartpole", *TINY, *FEW, *NORMALIZED]
    given += ["task.network.memory=4", "solver.ppo.anneal_updates=6"]
    assert run_there(tmp_path / "resumed", *given) == ""
    for folder in ("resumed", "whole"):
        assert run_there(tmp_path / folder, *given, "schedule.updates=6") == ""
    assert_same_run(tmp_path / "resumed", tmp_path / "whole")


@pytest.mark.slow
def test_a_frozen_proposer_comes_from_another_device(
    run_there: Run, train: Callable[..., int], tmp_path: Path
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    assert train("+method=perf_gain", *QUIET, *CYCLE, f"hydra.run.dir={here}") == 0
    assert run_there(there, "+method=frozen_proposer", *QUIET, f"checkpoint={here}") == ""


@pytest.mark.slow
def test_what_is_computed_there_is_what_is_computed_here(
    run_there: Run, train: Callable[..., int], tmp_path: Path
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    assert train(*SEEDS, f"hydra.run.dir={here}") == 0
    assert run_there(there, *SEEDS) == ""
    for name in ("metrics.csv", "training.csv"):
        for one, other in zip(read_csv(here / name), read_csv(there / name), strict=True):
            assert {**one, "seconds": 0} == pytest.approx({**other, "seconds": 0}, abs=1e-5)


class Careless(SamplingCurriculum):
    """Forgets that a Solver's numbers may lie elsewhere."""

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        rewards = outcome["rollout"]["next", "reward"]
        torch.zeros(rewards.shape).add_(rewards)


def careless(parts: Components, **_: Any) -> Curriculum:
    return Careless(parts.task.target)


@pytest.mark.slow
def test_what_mixes_devices_is_refused(run_there: Run, tmp_path: Path) -> None:
    said = run_there(tmp_path, *SEEDS, "curriculum._target_=tests.test_devices.careless")
    assert "on the CPU, others on the device" in said and "in observe" in said
