"""The command as users call it, in a folder of its own."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import shutil
import signal
from pathlib import Path

import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import proposer_rl
from proposer_rl.cli.groups import quoted
from proposer_rl.experiment import Experiment
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.folder import read_csv, read_jsonl
from proposer_rl.runs.process import Interrupted
from tests.commands import SMOKE, trained_run
from tests.same_run import tables

pytestmark = pytest.mark.usefixtures("own_folder")

FEW = [*SMOKE, "schedule.updates=2"]
COMMAND = ["+method=target", *FEW, "hydra.run.dir=run"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has come to its end."""
    return trained_run(tmp_path_factory.mktemp("finished") / "run", *COMMAND[:-1])


@pytest.fixture
def run(finished: Path, own_folder: None) -> Path:
    """A copy of it, where the command leaves its own."""
    return Path(shutil.copytree(finished, "run"))


def test_a_run_leaves_its_measurements(train, capsys) -> None:
    """Of every other method ``tests/test_needs.py`` makes a run."""
    assert train("+method=perf_gain", *SMOKE, "hydra.run.dir=run") == 0
    folder = Path("run")
    metrics = read_csv(folder / "metrics.csv")
    assert [row["updates"] for row in metrics] == [0, 2, 4, 6]
    assert metrics[-1]["frames"] == 6 * 4 * 5
    for name in ("id", "ood"):
        assert all(0 <= float(row[f"{name}_success"]) <= 1 for row in metrics)
    samples = read_jsonl(folder / "curriculum.jsonl")
    assert [sample["updates"] for sample in samples] == [2, 4, 6]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["method"] == "perf_gain" and summary["updates_to_threshold"] == [None]
    assert summary["versions"]["torchrl"] and summary["versions"]["torch"] == torch.__version__
    cycles = read_jsonl(folder / "cycles.jsonl")
    assert [row["cycle"] for row in cycles] == [0, 1]
    assert all(len(row["return_gain"]) == len(row["total_reward"]) == 2 for row in cycles)
    # In both cycles two copies of three updates, looked at before and after; and the Solver's own
    # action.
    assert metrics[-1]["curriculum_frames"] == 2 * 2 * 3 * 4 * 5
    assert metrics[-1]["evaluations"] == 2 * (2 * 2 + 1) * 16
    said = capsys.readouterr().out
    assert "not reached in 6 updates (censored)" in said and "run.png" in said


def test_a_run_ends_with_its_picture(finished: Path) -> None:
    assert (finished / "run.png").stat().st_size > 10_000


def test_a_frozen_proposer_sees_what_it_has_learnt_with(train, capsys) -> None:
    assert train("+method=perf_gain", *FEW, "hydra.run.dir=learnt") == 0
    arguments = ["+method=frozen_proposer", *SMOKE, "checkpoint=learnt", "hydra.run.dir=run"]
    assert train(*arguments, "proposer.observes=[return,progress]") == 2
    said = "checkpoint=learnt: its Proposer has learnt with observes=['log_success', 'progress']"
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("method", ["perf_gain", "first_order_proposer"])
def test_what_a_proposer_has_learnt_is_a_file_of_its_own(method: str, train) -> None:
    """Another run begins with it as it does with the whole run."""
    assert train(f"+method={method}", *FEW, "hydra.run.dir=learnt") == 0
    proposer = Path("learnt/proposer.pt")
    (whole,) = sorted(Path("learnt/checkpoints").glob("*.pt"))[-1:]
    assert proposer.stat().st_size < whole.stat().st_size / 2
    again = ["+method=frozen_proposer", *FEW]
    if method == "first_order_proposer":
        again += ["proposer/action=problems", "proposer.observes=[]", "proposer.action_repeat=1"]
    runs = {"of_run": "learnt", "of_file": str(proposer), "of_folder": "light"}
    Path("light").mkdir()
    shutil.copy(proposer, "light")
    for name, checkpoint in runs.items():
        assert train(*again, f"checkpoint={checkpoint}", f"hydra.run.dir={name}") == 0
        assert not Path(name, "proposer.pt").exists()  # it is that of another run
        assert tables(Path(name)) == tables(Path("of_run"))


def test_a_finished_run_can_be_made_longer_but_not_changed(run: Path, train, capsys) -> None:
    assert train(*COMMAND, "schedule.updates=4") == 0
    assert [row["updates"] for row in read_csv(run / "metrics.csv")] == [0, 2, 4]
    before = tables(run)
    assert train(*COMMAND, "solver.ppo.gamma=0.5") == 2
    assert "solver.ppo.gamma=0.5: the run in" in capsys.readouterr().err
    assert tables(run) == before


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_a_run_whose_files_were_rewritten_on_windows_goes_on(run: Path, train, mark: bytes) -> None:
    """By Excel, or by ``git config core.autocrlf``."""
    before = tables(run)
    files = [*run.glob("*.csv"), *run.glob("*.json*")]
    for file in files:
        file.write_bytes(mark + file.read_bytes().replace(b"\n", b"\r\n"))
    assert train(*COMMAND) == 0  # it is finished
    assert train(*COMMAND, "schedule.updates=4") == 0
    assert [row["updates"] for row in read_csv(run / "metrics.csv")] == [0, 2, 4]
    assert tables(run)["metrics.csv"][:2] == before["metrics.csv"]
    assert len(proposer_rl.Run(run).metrics) == 3
    summary = run / "summary.json"
    summary.write_bytes(mark + summary.read_bytes())
    assert proposer_rl.Run(run).summary["updates"] == 4
    assert proposer_rl.Run(run).solver().copies == 1


def test_a_table_that_cannot_be_read_is_named_before_training_goes_on(
    run: Path, train, capsys
) -> None:
    """As Excel writes it where commas are decimal signs."""
    table = run / "training.csv"
    table.write_text(table.read_text().replace(",", ";"))
    left = (run / "metrics.csv").read_bytes()
    assert train(*COMMAND, "schedule.updates=4") == 2
    error = capsys.readouterr().err
    assert "training.csv, line 2: " in error and error.count("\n") == 1
    assert (run / "metrics.csv").read_bytes() == left


def test_a_run_that_cannot_come_to_its_end_is_left_as_it_is(
    run: Path, train, monkeypatch, capsys
) -> None:
    before = tables(run)

    def refused(updates: int) -> str:
        capsys.readouterr()
        assert train(*COMMAND, f"schedule.updates={updates}") == 2
        assert tables(run) == before
        return capsys.readouterr().err

    (run / "summary.json").unlink()  # as if it had been interrupted just before
    assert train(*COMMAND) == 0
    with monkeypatch.context() as patched:
        patched.setattr(Experiment, "run", lambda _: os.kill(os.getpid(), signal.SIGINT))
        patched.setattr("proposer_rl.runs.process.StopSignals._keep", signal.default_int_handler)
        assert train(*COMMAND, "schedule.updates=4") == 128 + signal.SIGINT
    assert not (run / "summary.json").exists()  # it is not at the end of what was asked for
    assert train(*COMMAND) == 0
    shutil.rmtree(run / "checkpoints")
    assert "ended after 2 updates and has no checkpoint to go on from" in refused(4)
    monkeypatch.setattr("proposer_rl.cli.run.logger", None)  # nothing is left to be logged
    assert train(*COMMAND) == 0


def test_how_to_go_on_is_a_whole_command(train, monkeypatch, capsys) -> None:
    def stopped(_: Experiment) -> None:
        raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(Experiment, "run", stopped)
    monkeypatch.setenv("PYTHONPATH", f"own parts{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    own = Path("own/method/mine.yaml")
    own.parent.mkdir(parents=True)
    own.write_text((CONFIG_FOLDER / "method/target.yaml").read_text())
    arguments = ["+method=mine", *SMOKE]
    ends = [("hydra.run.dir=run", "run"), ("+sweep=quick hydra.sweep.dir=all seed=3", "all/")]
    for words, folder in ends:
        assert train("--config-dir", "own", *words.split(), *arguments) == 128 + signal.SIGTERM
        (told,) = re.findall(r"To go on: (.*)", capsys.readouterr().out)
        path, command, *words = shlex.split(told)
        assert path.startswith("PYTHONPATH=own parts") and command == "bin/train"
        assert words[:2] == ["--config-dir", "own"] and {*arguments} <= {w.lower() for w in words}
        assert not any(word.startswith("+sweep") for word in words)
        assert folder in words[-1]


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(st.characters(exclude_characters="\0\n\r$", codec="utf-8"), min_size=1))
@example("runs/é").via("letters that Hydra's grammar has not")
@example("a b=c,d").via("signs that it reads as its own")
@example("NULL").via("what it takes for something else")
@example("it's \\' \\").via("its quotes and escapes")
def test_a_folder_is_given_to_hydra_as_it_is(folder: str) -> None:
    parser = OverridesParser.create()
    override = parser.parse_override(quoted("hydra.run.dir", folder))
    assert str(override.value()) == folder


@pytest.mark.parametrize("error", [ValueError("a bug"), BrokenPipeError(32, "a lost process")])
def test_an_unforeseen_error_within_a_run_is_no_bad_input_and_none_of_the_disk(
    error: Exception, train, monkeypatch
) -> None:
    def broken(*_: object) -> float:
        raise error

    monkeypatch.setattr("proposer_rl.cli.run.train", broken)
    with pytest.raises(type(error), match=r"a bug|a lost process"):
        train("+method=target", *SMOKE, "hydra.run.dir=run")


@pytest.mark.parametrize(
    ("function", "place", "number"),
    [
        ("hydra.core.utils._save_config", "run", errno.EACCES),
        ("proposer_rl.cli.watch.draw_run", "run", errno.ENOSPC),
        ("logging.FileHandler._open", "run/train.log", errno.EFBIG),
    ],
)
def test_a_disk_that_cannot_be_written_to_is_named_with_its_folder(
    function: str, place: str, number: int, train, monkeypatch, capsys
) -> None:
    """Whoever writes: Hydra, logging or matplotlib, which do not say where."""

    def full(*_: object, **__: object) -> None:
        named = [str(Path("run/train.log").absolute())] if place != "run" else []
        raise OSError(number, os.strerror(number), *named)

    monkeypatch.setattr(function, full)
    assert train(*COMMAND) == 4
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line == f"error: cannot use {Path(place).absolute()}: {os.strerror(number)}"


def test_a_run_goes_on_in_the_precision_that_it_began_with(
    run: Path, train, capsys, monkeypatch
) -> None:
    config, longer = run / "config.json", [*COMMAND, "schedule.updates=4"]
    assert json.loads(config.read_text())["precision"] == "fp32"
    monkeypatch.setattr("proposer_rl.tasks.mazes.task.faster_precision", lambda *_: "bf16")
    assert train(*longer) == 0
    assert json.loads(config.read_text())["precision"] == "fp32"
    assert train(*longer, "precision=bf16") == 2
    assert "error: precision='bf16': the run in" in capsys.readouterr().err
    config.write_text(config.read_text().replace('"fp32"', '"fp8"'))  # as nobody has written it
    assert train(*longer, "precision=fp32", "schedule.updates=6") == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: precision='fp32': the run in") and "'fp8'" in error
