"""Sweeps: stopped and started again, with failures, on Hydra's launchers; seeds side by side."""

from __future__ import annotations

import gc
import json
import signal
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import OmegaConf

from proposer_rl import recipes
from proposer_rl.cli.config import RunConfig
from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.groups import settings_name
from proposer_rl.cli.train import FailedRunError, main
from proposer_rl.experiment import Experiment
from proposer_rl.methods import completed
from proposer_rl.recipes import CONFIG_FOLDER, available, plain_values
from proposer_rl.runs.folder import read_csv, read_jsonl
from proposer_rl.runs.process import Interrupted, locked
from proposer_rl.tasks.gymnasium.player import LevelPlayer
from tests.commands import SMOKE, call

FEW = [*SMOKE, "schedule.updates=2"]


@pytest.fixture
def train(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Call the command in this process and a folder of its own; returns its exit code."""
    monkeypatch.chdir(tmp_path)
    # Launchers start other processes, which shall run this checkout too.
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    return partial(call, main)


def measured(folder: Path, seed: int) -> dict[str, object]:
    """All that was measured of a seed, without what depends on the clock or on other seeds."""
    found: dict[str, object] = {}
    for path in sorted(folder.glob("*.csv")):
        rows = [row for row in read_csv(path) if row["seed"] == seed]
        found[path.name] = [{**row, "seconds": 0} for row in rows]
    samples = read_jsonl(folder / "curriculum.jsonl")
    found["samples"] = [row for row in samples if row["seed"] == seed]
    return found


def test_a_finished_run_leaves_no_environments_in_memory(train) -> None:
    def players() -> list[object]:
        return [each for each in gc.get_objects() if isinstance(each, LevelPlayer)]

    gc.collect()
    before = len(players())
    gc.disable()  # the collector comes by sooner or later, but by then the next run has its own
    try:
        small = ["task.evaluation.levels=2", "solver.batch_size=2", "solver.ppo.horizon=8"]
        few = ["solver.ppo.minibatches=1", "schedule.updates=1", "compute.progress=false"]
        assert train("-m", "task=cartpole", "+method=target", *small, *few) == 0
        assert len(players()) == before
    finally:
        gc.enable()


def test_seeds_side_by_side_give_what_they_give_alone(train) -> None:
    command = ["+method=hand_designed", *FEW, "hand_designed.until=[1]"]
    assert train(*command, "seeds=[2,0]", "hydra.run.dir=together") == 0
    for seed in (2, 0):
        assert train(*command, f"seed={seed}", f"hydra.run.dir={seed}") == 0
        alone, together = measured(Path(str(seed)), seed), measured(Path("together"), seed)
        assert alone["samples"] == together["samples"]
        # Sums over another batch are rounded in another order.
        for table, near in (("metrics.csv", {}), ("training.csv", {"rel": 1e-3})):
            for row, other in zip(alone[table], together[table], strict=True):
                assert row == pytest.approx(other, abs=1e-6, **near)
    summary = json.loads(Path("together/summary.json").read_text())
    assert summary["seeds"] == [2, 0] and len(summary["updates_to_threshold"]) == 2


def states(folder: Path) -> dict[str, float]:
    """When the summary of each run was written."""
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("*/summary.json")}


def test_a_sweep_skips_what_is_finished_and_goes_on_where_it_broke(
    train, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    sweep = ["-m", "+method=target,hand_designed", "seed=0,1", *FEW, "hydra.sweep.dir=all"]
    sweep.append("schedule.updates=4")
    updates = []
    original = Experiment._update

    def breaking(self: Experiment) -> None:
        updates.append(self.updates)
        if len(updates) == 4 + 4:  # in the second run, after its checkpoint at update 2
            raise KeyboardInterrupt
        original(self)

    monkeypatch.setattr(Experiment, "_update", breaking)
    assert train(*sweep) == 130
    before = states(Path("all"))
    assert len(before) == 1
    updates.clear()
    updates += [0] * 100  # never breaks again
    capsys.readouterr()
    assert train(*sweep) == 0
    assert updates[100:102] == [2, 3]  # the broken run, from its checkpoint
    assert len(updates) == 100 + 2 + 2 * 4  # the finished one not at all
    after = states(Path("all"))
    assert len(after) == 4 and before.items() <= after.items()
    said = capsys.readouterr().out
    assert said.count("finished before, nothing to do") == 1 and "4 runs: 4 finished" in said


def test_a_failed_run_is_listed_and_tried_again(
    train, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    sweep = ["-m", "+method=target", "seed=0,1", *FEW, "hydra.sweep.dir=all"]
    original = Experiment.run

    def failing(self: Experiment):
        if self.seeds == [0]:  # the first: the other is run nevertheless
            raise RuntimeError("the disk\nis on fire")
        return original(self)

    with monkeypatch.context() as patch:
        patch.setattr(Experiment, "run", failing)
        assert train(*sweep) == 1
    printed = capsys.readouterr()
    assert "the disk is on fire" in printed.out
    assert "2 runs: 1 finished, 1 failed" in printed.out
    assert "Traceback" in printed.err and "error: the disk is on fire" in printed.err
    assert train("-m", "+method=hand_designed", "seed=0,1", *FEW, "hydra.sweep.dir=all") == 0
    assert "4 runs: 3 finished, 1 failed" in capsys.readouterr().out  # not in the second sweep
    assert train(*sweep) == 0
    assert "4 runs: 4 finished" in capsys.readouterr().out
    assert not list(Path("all").rglob("error.json"))


def test_a_run_that_another_process_works_on_has_not_failed(train, capsys) -> None:
    sweep = ["-m", "+method=target", "seed=0,1", *FEW, "hydra.sweep.dir=all"]
    assert train(*sweep) == 0
    (taken,) = Path("all").glob("target_*_seed_1")
    (taken / "summary.json").unlink()
    with locked(taken):
        assert train(*sweep) == 0
    assert f"{taken.name} is in use by process" in capsys.readouterr().err
    assert not list(Path("all").rglob("error.json"))
    assert train(*sweep) == 0
    assert "2 runs: 2 finished" in capsys.readouterr().out


def test_a_sweep_of_more_finds_the_runs_that_are_finished(train, capsys) -> None:
    """Hydra numbers the jobs of a grid with a value in front anew (hydra#1407, #3328)."""
    sweep = ["-m", "+method=target", *FEW, "hydra.sweep.dir=all"]
    assert train(*sweep, "seed=0", "+filter=none") == 0
    before = states(Path("all"))
    capsys.readouterr()
    assert train(*sweep, "+filter=learnability,none", "seed=0") == 0
    assert len(before) == 1 and before.items() < states(Path("all")).items()
    said = capsys.readouterr().out
    assert said.count("finished before") == 1 and "2 runs: 2 finished" in said
    assert not list(Path("all").rglob("error.json"))


def test_a_method_with_and_without_its_ablation_in_any_order(composed) -> None:
    made = composed(
        *("-m", "+ablation=none,paper_literal", "+scale=smoke", "+method=perf_gain"),
        "hydra.sweep.dir=all",
    )
    assert {path: run.ablation for path, run in made.items()} == {
        f"all/perf_gain_ablation={name},scale=smoke_seed_0": name
        for name in ("none", "paper_literal")
    }


def test_settings_name_a_folder() -> None:
    names = {
        name: settings_name(OmegaConf.create(overrides))
        for name, overrides in {
            "": ["method=plr", "seed=1", "compute.device=cpu", "logger=wandb", "sweep=quick"],
            "as=dcd,scale=quick": ["seeds=[0,1]", "scale=quick", "+as=dcd"],
            "pool.keep=8,solver.ppo.gamma=0.9": ["solver.ppo.gamma=0.9", "pool.keep=8"],
        }.items()
    }
    assert all(found == name for name, found in names.items())
    # What no folder can be called stays apart.
    values = ["task=arena/hill", "task=arena-hill", "x=[1,2]", "x=[1-2]", "y=" + "a" * 999]
    found = [settings_name(OmegaConf.create([value])) for value in [*values, values[-1] + "b"]]
    assert len(set(found)) == len(found)
    assert all("/" not in name and len(name) < 150 for name in found)


class Noted(Callback):
    """What Hydra's launchers give to sweepers."""

    seen: ClassVar[list[JobReturn]] = []

    def on_job_end(self, config: Any, job_return: JobReturn, **_: Any) -> None:
        """Notes how a run ended."""
        self.seen.append(job_return)


def test_sweepers_see_which_runs_failed(train) -> None:
    """Optuna's counts failures up to max_failure_rate; a value of NaN would end its study."""
    Noted.seen.clear()
    watched = f"+hydra.callbacks.noted._target_={__name__}.Noted"
    assert train("-m", "+method=target", "solver.batch_size=0,4", *FEW, watched) == 2
    failed, made = Noted.seen
    assert (failed.status, made.status) == (JobStatus.FAILED, JobStatus.COMPLETED)
    with pytest.raises(FailedRunError, match=r"^solver\.batch_size=0: ") as raised:
        _ = failed.return_value
    assert raised.value.__context__ is None  # its frames would hold the run's memory
    assert 0 <= made.return_value <= 1


def test_a_folder_below_the_home_folder(train, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(home := Path("home dir").absolute()))
    monkeypatch.setattr("proposer_rl.cli.run.parts", stopped)
    runs = {"hydra.run.dir=~/a": "a", "hydra.run.dir='~/b'": "b"}
    for word, name in runs.items():
        assert train("+method=target", word) == 2
        assert (home / name).is_dir()
    assert train("-m", "+method=target", "seed=0,1", "hydra.sweep.dir='~/c'") == 2
    assert len(list((home / "c").glob("*_seed_*"))) == 2
    assert not Path("~").exists()


def stopped(*_: object) -> None:
    raise ConfigError("enough")


@pytest.mark.slow
@pytest.mark.parametrize(
    "launcher",
    [
        # The second is refused before it imports PyTorch, which takes a process most of its time.
        ["task=maze,cartpole", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        ["solver.batch_size=0,4", "hydra/launcher=submitit_local"],
    ],
    ids=["joblib", "submitit"],
)
def test_other_launchers_run_a_sweep(launcher: list[str], train, capfd) -> None:
    arguments = ["-m", "+method=target", *launcher, *FEW, "hydra.sweep.dir=all"]
    assert train(*arguments) == 2
    assert len(states(Path("all"))) == 1
    assert "2 runs: 1 finished, 1 failed" in capfd.readouterr().out


@pytest.mark.slow
def test_a_job_that_is_stopped_is_interrupted_and_its_sweep_says_so(
    train, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """Submitit waits for a result of every job, which a process that exits does not leave."""

    def stopped(self: Experiment) -> dict[str, float]:
        if self.seeds == [0]:
            raise Interrupted(signal.SIGUSR2)
        return original(self)

    original = Experiment.run
    arguments = ["-m", "+method=target", "seed=0,1", *FEW, "hydra.sweep.dir=all"]
    monkeypatch.setenv("SUBMITIT_EXECUTOR", "slurm")
    with monkeypatch.context() as patched:
        patched.setattr(Experiment, "run", stopped)
        assert train(*arguments) == 128 + signal.SIGUSR2
    said = capsys.readouterr()
    assert "2 runs: 1 finished" in said.out and "failed" not in said.out
    assert "Traceback" not in said.err
    assert train(*arguments) == 0


@pytest.fixture
def composed(train, monkeypatch: pytest.MonkeyPatch):
    """Which runs a sweep makes, by their folders, without making them: each stops when composed."""

    def call(*arguments: str) -> dict[str, RunConfig]:
        made: dict[str, RunConfig] = {}

        def note(config: RunConfig, *_):
            path = Path(HydraConfig.get().runtime.output_dir).relative_to(Path.cwd()).as_posix()
            assert path not in made
            made[path] = config
            raise KeyError("enough")

        monkeypatch.setattr("proposer_rl.cli.run.parts", note)
        assert train(*arguments) == 1
        return made

    return call


# Each run is composed twice: all methods of one sweep, one method of the others.
@pytest.mark.parametrize(
    ("name", "few"), [("paper", []), ("medium", ["+method=target"]), ("quick", ["+method=target"])]
)
def test_the_experiment_is_one_command(name: str, few: list[str], composed) -> None:
    seeds = (0, 3) if few else (3,)
    made = composed(f"+sweep={name}", *few, f"seed={','.join(map(str, seeds))}")
    planned = OmegaConf.load(CONFIG_FOLDER / "sweep" / f"{name}.yaml").hydra.sweeper.params
    swept = set(planned["method"].split(","))
    assert {"perf_gain", "task_difficulty", "target", "domain_randomization"} <= swept
    methods = {"target"} if few else swept
    folders = {f"sweeps/{name}/{method}-none-seed_{seed}" for method in methods for seed in seeds}
    assert made.keys() == folders
    assert {(run.method, run.ablation) for run in made.values()} == {(m, "none") for m in methods}


def test_a_proposer_is_used_on_a_solver_that_it_has_not_seen(composed) -> None:
    """The literal Proposer and the frozen one lie beside the methods at medium scale."""
    made = composed("+sweep=medium_frozen", "seed=107")
    made |= composed("+sweep=medium", "+method=perf_gain", "+ablation=paper_literal", "seed=107")
    assert {path: (run.checkpoint, run.seed) for path, run in made.items()} == {
        "sweeps/medium/frozen_proposer-none-seed_107": ("results/medium/proposer.pt", 107),
        "sweeps/medium/perf_gain-paper_literal-seed_107": (None, 107),
    }


def test_the_arena_is_one_command_and_one_more_method_one_more_row(composed) -> None:
    folder, seeds = "sweeps/arena/arena/hill", [*range(100, 110)]
    ((path, asks),) = composed(
        "+sweep=arena_develop", "task=arena/hill", "+method=no_oracle/currot"
    ).items()
    assert path == f"{folder}/currot-modelled-seed_{'-'.join(map(str, seeds))}"
    assert asks.seeds == seeds and asks.model is not None
    ((path, few),) = composed(
        "+sweep=arena", "task=arena/hill", "+method=ncc", "seeds=[1,2]"
    ).items()
    assert path == f"{folder}/ncc-none-seed_1-2"
    assert few.method == "ncc" and few.seeds == [1, 2] and few.model is None


def test_the_arena_has_every_task_in_one_half_and_known_rows() -> None:
    planned = OmegaConf.load(CONFIG_FOLDER / "sweep/arena.yaml").hydra.sweeper.params
    develop = OmegaConf.load(CONFIG_FOLDER / "sweep/arena_develop.yaml").hydra.sweeper.params
    halves = [*planned.task.split(","), *develop.task.split(",")]
    assert len(set(halves)) == len(halves)
    assert {f"arena/{name}" for name in available("task/arena")} <= set(halves)
    rows = planned["method"].split(",")
    assert {"target", "domain_randomization"} <= set(rows)
    for row in rows:  # of what asks for success nothing asks more of the task than episodes
        curriculum = completed(plain_values(recipes.composed([f"method={row}"])))["curriculum"]
        assert curriculum.get("source", "episodes") == "episodes"
