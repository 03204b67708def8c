"""The command as users call it, in a folder of its own."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from proposer_rl.checkpoint import load_latest
from proposer_rl.cli.config import CONFIG_FOLDER, RunConfig, methods, read_config
from proposer_rl.cli.train import build, main
from proposer_rl.experiment import Experiment, Schedule
from proposer_rl.ppo import PPOSettings
from proposer_rl.run_folder import read_csv, read_jsonl
from proposer_rl.task import EvaluationSettings, MazeSettings

SMOKE = ["+scale=smoke", "progress=false"]
ABLATIONS = sorted(file.stem for file in (CONFIG_FOLDER / "ablation").glob("*.yaml"))


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def train(monkeypatch: pytest.MonkeyPatch):
    """Call the command in this process; returns its exit code."""

    def call(*arguments: str) -> int:
        GlobalHydra.instance().clear()
        monkeypatch.setattr(sys, "argv", ["proposer-train", *arguments])
        try:
            main()
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    return call


def composed(*overrides: str) -> RunConfig:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        return read_config(compose("train", list(overrides)))


def tables(folder: Path) -> dict[str, Any]:
    """All that a run measured, without wall-clock times."""
    found: dict[str, Any] = {}
    for path in sorted(folder.glob("*.csv")):
        found[path.name] = [{**row, "seconds": 0} for row in read_csv(path)]
    for path in sorted(folder.glob("*.jsonl")):
        found[path.name] = path.read_bytes()
    return found


def weights(folder: Path) -> dict[str, torch.Tensor]:
    latest = load_latest(folder / "checkpoints")
    assert latest is not None
    return {name: entry["value"] for name, entry in latest[1]["solver"].items()}


def assert_same_run(one: Path, other: Path) -> None:
    assert tables(one) == tables(other)
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("method", methods())
def test_every_method_runs_and_leaves_its_measurements(method: str, train, capsys) -> None:
    arguments = [f"+method={method}", *SMOKE]
    if method == "frozen_proposer":
        assert train("+method=perf_gain", *SMOKE, "seed=1", "hydra.run.dir=learnt") == 0
        arguments.append("checkpoint=learnt")
    assert train(*arguments, "hydra.run.dir=run") == 0
    folder = Path("run")
    metrics = read_csv(folder / "metrics.csv")
    assert [row["updates"] for row in metrics] == [0, 2, 4, 6]
    assert metrics[-1]["frames"] == 6 * 4 * 10
    for name in ("id", "ood"):
        assert all(0 <= float(row[f"{name}_success"]) <= 1 for row in metrics)
    samples = read_jsonl(folder / "curriculum.jsonl")
    assert [sample["updates"] for sample in samples] == [2, 4, 6]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["method"] == method and summary["updates_to_threshold"] == [None]
    assert summary["versions"]["torchrl"]
    assert (folder / "run.png").stat().st_size > 10_000
    proposes = (folder / "proposer.jsonl").exists()
    assert proposes == (method in ("perf_gain", "task_difficulty"))
    if proposes:
        cycles = read_jsonl(folder / "proposer.jsonl")
        assert [row["cycle"] for row in cycles] == [0, 1]
        assert all(len(row["total_gain"]) == 2 for row in cycles)
        assert metrics[-1]["meta_frames"] == 2 * 2 * 3 * 4 * 10
    said = capsys.readouterr().out
    assert "not reached in 6 updates (censored)" in said and "run.png" in said


@pytest.mark.parametrize("ablation", ABLATIONS)
def test_every_ablation_composes_and_is_built(ablation: str, tmp_path: Path) -> None:
    config = composed("+method=perf_gain", *SMOKE, f"+ablation={ablation}")
    assert config.ablation == ablation
    plain = composed("+method=perf_gain", *SMOKE)
    if ablation not in ("advance_train", "lookahead_50", "probes_16", "ratio_per_problem"):
        changed = config.model_dump(exclude={"ablation"}) != plain.model_dump(exclude={"ablation"})
        assert changed
    build(config, tmp_path / "run")


@pytest.mark.parametrize("ablation", ["observe_agent", "evaluator_rollout", "advance_best"])
def test_ablations_that_change_the_loop_run(ablation: str, train) -> None:
    arguments = ["+method=perf_gain", *SMOKE, f"+ablation={ablation}"]
    assert train(*arguments, "hydra.run.dir=run") == 0
    assert read_csv("run/metrics.csv")[-1]["updates"] == 6


class Stop(Exception):
    """A crash."""


# Counted in Solver updates and improvements together: within a cycle, before and after improving.
@pytest.mark.parametrize("method", ["perf_gain", "hand_made"])
@pytest.mark.parametrize("crash_after", [1, 3, 4, 5])
def test_an_interrupted_run_resumes_as_if_it_had_never_stopped(
    method: str, crash_after: int, train, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = [f"+method={method}", *SMOKE]
    assert train(*arguments, "hydra.run.dir=whole") == 0
    done = []
    with monkeypatch.context() as patch:
        for name in ("_update", "_improve"):
            original = getattr(Experiment, name)

            def crashing(self, original=original):
                if len(done) == crash_after:
                    raise Stop
                original(self)
                done.append(1)

            patch.setattr(Experiment, name, crashing)
        with pytest.raises(Stop):
            train(*arguments, "hydra.run.dir=parts")
    assert not Path("parts/summary.json").exists()
    assert train(*arguments, "hydra.run.dir=parts") == 0
    assert_same_run(Path("whole"), Path("parts"))


def test_the_seed_decides_everything(train) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert train("+method=perf_gain", *SMOKE, f"seed={seed}", f"hydra.run.dir={name}") == 0
    assert_same_run(Path("a"), Path("b"))
    assert tables(Path("a")) != tables(Path("c"))


def test_more_evaluation_levels_do_not_change_training(train) -> None:
    for name, levels in (("a", 4), ("b", 9)):
        options = ["hydra.run.dir=" + name, f"evaluation.levels={levels}"]
        assert train("+method=perf_gain", *SMOKE, *options) == 0
    first, second = weights(Path("a")), weights(Path("b"))
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_a_finished_run_can_be_made_longer_but_not_changed(train, capsys) -> None:
    arguments = ["+method=target", *SMOKE, "hydra.run.dir=run"]
    assert train(*arguments) == 0
    assert train(*arguments, "schedule.updates=8") == 0
    assert [row["updates"] for row in read_csv("run/metrics.csv")] == [0, 2, 4, 6, 8]
    before = tables(Path("run"))
    assert train(*arguments, "solver.ppo.gamma=0.5") == 2
    assert "solver.ppo.gamma: the run in" in capsys.readouterr().err
    assert tables(Path("run")) == before


def test_a_run_goes_on_in_the_precision_that_it_began_with(train, capsys, monkeypatch) -> None:
    command = ["+method=target", *SMOKE, "schedule.updates=2", "hydra.run.dir=run"]
    assert train(*command) == 0
    assert json.loads(Path("run/config.json").read_text())["precision"] == "fp32"
    monkeypatch.setattr("proposer_rl.cli.train.faster_precision", lambda *_: "bf16")
    assert train(*command) == 2
    assert "error: precision: the run in" in capsys.readouterr().err


def test_multirun_goes_over_methods_and_seeds(train) -> None:
    assert train("-m", "+method=target,domain_randomization", "seed=0,1", *SMOKE) == 0
    summaries = [json.loads(file.read_text()) for file in Path().glob("multirun/*/*/summary.json")]
    found = {(summary["method"], summary["seed"]) for summary in summaries}
    assert found == {(m, s) for m in ("target", "domain_randomization") for s in (0, 1)}


def test_a_failing_run_of_a_multirun_does_not_take_the_others_with_it(train, capsys) -> None:
    assert train("-m", "+method=target", "solver.ppo.epochs=0,1", *SMOKE) == 2
    assert "solver.ppo.epochs=0: input should be" in capsys.readouterr().err
    assert len(list(Path().glob("multirun/*/*/summary.json"))) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "choose one with +method=NAME, NAME one of: domain_randomization, frozen_proposer"),
        (["+method=magic"], "method/magic: unknown; choose one of: domain_randomization, fro"),
        (["+method=target", "+scale=tiny"], "scale/tiny: unknown; choose one of: paper, quick"),
        (["+method=target", "sede=1"], "Could not override 'sede'"),
        (["+method=target", "+sede=1"], "sede: there is no such key"),
        (["+method=target", "solver.ppo.epochs=many"], "solver.ppo.epochs='many': input should be"),
        (
            ["+method=target", "solver.ppo.learning_rate=-1"],
            "learning_rate=-1: input should be gre",
        ),
        (["+method=target", "solver.problems=0"], "solver.problems=0: input should be greater"),
        (["+method=target", "target=elsewhere"], "target: must be among ['id', 'mix', 'ood'], got"),
        (["+method=target", "evaluation.distributions=[far]"], "evaluation.distributions: must be"),
        (
            ["+method=target", "schedule.headline=fun"],
            "headline='fun': must be one of ['id_success'",
        ),
        (["+method=target", "maze.height=2"], "halve a 2x10 maze to nothing"),
        (["+method=target", "solver.channels=[12]"], "must be multiples of solver.groups=8"),
        (["+method=target", "device=abacus"], "device='abacus': must be auto, cpu or a usable"),
        (
            ["+method=target", "precision=fp8"],
            "precision='fp8': input should be 'auto', 'fp32' or 'bf16'",
        ),
        (["+method=hand_made", "curriculum.until=[3, 2]"], "2 stages need 1 ascending positive"),
        (["+method=hand_made", "curriculum.distributions=[x]"], "among ['id', 'mix', 'ood'], got"),
        (["+method=perf_gain", "+curriculum.x=1"], "curriculum: proposer() got an unexpected"),
        (
            ["+method=perf_gain", "+ablation=lookahead_10", "+scale=quick"],
            "+scale: must come before +ablation",
        ),
        (["+method=perf_gain", "proposer.ppo.horizon=3"], "must equal proposer.lookahead=50"),
        (
            ["+method=perf_gain", "proposer.advance=best", "schedule.cycle_length=5"],
            "schedule.cycle_length=5 must equal proposer.lookahead=50",
        ),
        (
            ["+method=target", "distributions.id.specifications=[[0.99, 50]]"],
            "obstacle_fraction=0.99, path_length=50 on a 10x10 grid",
        ),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_2(arguments, message, train, capsys) -> None:
    assert train(*arguments, "hydra.run.dir=run") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ")
    assert message in lines[0]
    written = {path.name for path in Path("run").glob("*")}
    assert written <= {".hydra", "train.log"}


def test_the_papers_values_are_the_defaults_of_the_code() -> None:
    config = composed("+method=perf_gain", "+scale=paper")
    assert config.maze == MazeSettings()
    assert config.solver.ppo == PPOSettings()
    assert config.schedule == Schedule()
    assert config.evaluation == EvaluationSettings(distributions=["id", "ood"])
    for part in (config.solver, config.proposer):
        for field in fields(part):
            if isinstance(field.default, int | float | str):
                assert getattr(part, field.name) == field.default, field.name
    own = {"horizon": 50, "updates": 3, "epochs": 16, "gamma": 1.0}
    assert asdict(config.proposer.ppo) == {**asdict(PPOSettings()), **own}


def test_the_module_runs_as_a_program() -> None:
    command = [sys.executable, "-m", "proposer_rl.cli.train", "+method=target", *SMOKE]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "outputs/target/" in result.stdout
    shutil.rmtree("outputs")
