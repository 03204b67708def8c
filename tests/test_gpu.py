"""Everything that computes, on a GPU."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.modules import ProbabilisticActor

import proposer_rl as prl
from proposer_rl.cli import eval as evaluation
from proposer_rl.cli.build import build, make_task, parts
from proposer_rl.experiment import Experiment
from proposer_rl.learning import PPO
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.folder import RunFolder, read_csv
from proposer_rl.runs.process import Interrupted, StopSignals
from proposer_rl.streams import Streams
from tests.commands import trained_run
from tests.same_run import StopAt, assert_same_run
from tests.tasks.gymnasium.toys import CHOICES, GATE, TINY
from tests.tiny import EXAMPLES, composed

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

QUIET = ["compute.progress=false", "compute.device=cuda"]
COMPILED = "compute.compile=true"
SMOKE = ["+scale=smoke", *QUIET]
METHODS = sorted(file.stem for file in (CONFIG_FOLDER / "method").glob("*.yaml"))
NORMALIZED = [f"solver.ppo.normalize_{name}=true" for name in ("observations", "rewards")]
TASKS = {
    "maze": SMOKE,
    "bf16": [*SMOKE, "precision=bf16"],
    "view_maze": ["task=view_maze_smoke", *QUIET, "schedule.updates=4"],
    "cartpole": ["task=cartpole", *TINY, *QUIET],
    "cartpole_normalized": ["task=cartpole", *TINY, *QUIET, *NORMALIZED],
    "cartpole_memory": ["task=cartpole", *TINY, *QUIET, "task.network.memory=8"],
    "choices": [*CHOICES, *QUIET],
    "lunar_lander": ["task=lunar_lander", *TINY, *QUIET],
    "minigrid": ["task=minigrid", *TINY, *QUIET],
    "point_mass": ["task=point_mass", *GATE, *QUIET],
    "compiled": [*SMOKE, COMPILED],
    "compiled_bf16": [*SMOKE, COMPILED, "precision=bf16"],
    "compiled_view_maze": ["task=view_maze_smoke", *QUIET, "schedule.updates=4", COMPILED],
}
MODELLED = ["plr", "model_transport"]
SEVERAL = ["perf_gain", "domain_randomization", "first_order_gain", *MODELLED]


def experiment(folder: Path, *overrides: str, signals: StopSignals | None = None) -> Experiment:
    """As the command makes it."""
    config, signals = composed(*overrides), signals or StopSignals()
    return build(config, parts(config, signals), RunFolder(folder), signals)


def learner(device: str, *overrides: str, copies: int = 1) -> PPO:
    """Solvers on mazes, the same on every device."""
    config = composed("+method=target", "+scale=quick", f"compute.device={device}", *overrides)
    task = make_task(config)
    ppo = task.learner([Streams(k, "solver") for k in range(copies)])
    levels = task.target.sample([copies, 32], Streams(0).generator("levels"))
    ppo.env.set_levels(levels)
    return ppo


def generators(copies: int) -> list[torch.Generator]:
    return [Streams(k).generator("actions") for k in range(copies)]


@pytest.fixture
def full_precision(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Products of fp32 without TF32, so that they are the CPU's but for the order of their sums."""
    before = torch.get_float32_matmul_precision()
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda _: None)
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    yield
    torch.set_float32_matmul_precision(before)


@pytest.mark.parametrize("method", METHODS)
def test_each_method_trains(method: str, tmp_path: Path) -> None:
    given = [f"+method={method}", *SMOKE]
    if method == "frozen_proposer":
        experiment(tmp_path / "first", "+method=perf_gain", *SMOKE).run()
        given.append(f"checkpoint={tmp_path / 'first'}")
    experiment(tmp_path / "run", *given).run()
    last = read_csv(tmp_path / "run" / "metrics.csv")[-1]
    assert last["updates"] == 6
    assert all(math.isfinite(value) for value in last.values() if isinstance(value, float))


@pytest.mark.parametrize("method", ["plr", "perf_gain", "model_transport"])
@pytest.mark.parametrize("task", TASKS)
def test_each_task_trains(task: str, method: str, tmp_path: Path) -> None:
    experiment(tmp_path, f"+method={method}", *TASKS[task]).run()
    assert read_csv(tmp_path / "metrics.csv")[-1]["updates"] >= 4


@pytest.mark.parametrize("copies", [1, 3])
def test_an_update_is_the_cpus_up_to_rounding(copies: int, full_precision: None) -> None:
    here, there = (learner(device, copies=copies) for device in ("cpu", "cuda"))
    for _ in range(2):
        one, other = (ppo.update(generators(copies)) for ppo in (here, there))
        same = (one.rollout["action"] == other.rollout["action"].cpu()).float().mean()
        assert same > 0.99  # a uniform number may lie between two cumulative probabilities
        for key, value in one.metrics.items():
            torch.testing.assert_close(other.metrics[key].cpu(), value, rtol=0.05, atol=2e-3)


@pytest.mark.parametrize("copies", [1, 3])
def test_an_update_waits_for_nothing(copies: int) -> None:
    ppo = learner("cuda", copies=copies)
    ppo.update(generators(copies))  # constants are made, kernels are chosen
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        ppo.update(generators(copies))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    ppo.check()


def test_what_is_measured_is_what_the_cpu_measures(full_precision: None) -> None:
    found = []
    for device in ("cpu", "cuda"):
        config = composed("+method=target", "+scale=quick", f"compute.device={device}")
        task = make_task(config)
        measured = task.measure(task.learner([Streams(0, "solver")]).agent)
        found.append({key: value.cpu() for key, value in measured.items(True, True)})
    assert found[0].keys() == found[1].keys()
    for key, value in found[0].items():
        torch.testing.assert_close(found[1][key], value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("task", "method"),
    [
        *product(["maze"], SEVERAL),
        *product(["view_maze", "point_mass", "cartpole_normalized", "minigrid"], MODELLED),
    ],
)
def test_the_same_command_gives_the_same_bytes_also_after_a_stop(
    task: str, method: str, tmp_path: Path
) -> None:
    given = [f"+method={method}", *TASKS[task]]
    experiment(tmp_path / "one", *given).run()
    with pytest.raises(Interrupted):
        experiment(tmp_path / "other", *given, signals=StopAt(3)).run()
    experiment(tmp_path / "other", *given).run()
    assert_same_run(tmp_path / "one", tmp_path / "other")


@pytest.mark.parametrize(
    "task", ["maze", "bf16", "view_maze", "point_mass", "cartpole", "compiled"]
)
def test_graphs_change_no_byte(task: str, tmp_path: Path) -> None:
    given = ["+method=perf_gain", *TASKS[task]]
    experiment(tmp_path / "one", *given).run()
    experiment(tmp_path / "other", *given, "compute.graphs=false").run()
    assert_same_run(tmp_path / "one", tmp_path / "other")


def test_a_task_that_makes_its_levels_on_the_cpu_is_computed_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    from own_task import SledgeTask

    settings = {
        "solver": {"batch_size": 4, "ppo": {"horizon": 8}},
        "schedule": {"headline": "target_success"},
    }
    task = prl.tasks.own(SledgeTask, levels=8)
    with pytest.warns(UserWarning, match="computed on cpu instead of cuda"):
        run = prl.train(task, "plr", updates=2, folder=tmp_path, settings=settings, progress=False)
    assert run.task().device.type == "cpu"


@pytest.mark.parametrize(("first", "then"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_run_goes_on_on_another_device(first: str, then: str, tmp_path: Path) -> None:
    given = ["+method=perf_gain", *SMOKE]
    with pytest.raises(Interrupted):
        stop = StopAt(3)
        experiment(tmp_path, *given, f"compute.device={first}", signals=stop).run()
    experiment(tmp_path, *given, f"compute.device={then}").run()
    assert read_csv(tmp_path / "metrics.csv")[-1]["updates"] == 6


def test_replicas_are_trained_in_two_processes(tmp_path: Path) -> None:
    given = ["+method=perf_gain", *SMOKE]
    several = ["compute.collector=multiprocess", "compute.workers=2"]
    experiment(tmp_path / "one", *given).run()
    experiment(tmp_path / "two", *given, *several).run()
    one, two = (read_csv(tmp_path / name / "metrics.csv")[-1] for name in ("one", "two"))
    assert {**two, "seconds": 0} == pytest.approx({**one, "seconds": 0}, rel=0.05, abs=1e-3)


def test_runs_are_evaluated_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trained_run(tmp_path, "+method=target", *SMOKE, "seeds=[0,1]")
    evaluation.main([str(tmp_path), "--levels", "id"])
    assert "success" in capsys.readouterr().out


def test_a_teacher_in_a_loop_on_the_gpu() -> None:
    space = prl.Parameters({"gravity": (5.0, 25.0)})
    teacher = prl.Teacher(prl.curricula.plr(capacity=8), space, block=8)
    device = torch.device("cuda")
    made = GymEnv("CartPole-v1", device=device, categorical_action_encoding=True)
    env = TransformedEnv(made, prl.LevelTransform(teacher, lambda env, level: None))
    logits = TensorDictModule(nn.Linear(4, 2, device=device), ["observation"], ["logits"])
    kind = {"distribution_class": Categorical, "return_log_prob": True}
    actor = ProbabilisticActor(logits, in_keys=["logits"], **kind)
    for _ in Collector(env, actor, frames_per_batch=128, total_frames=512, device=device):
        pass
    assert teacher.log()
