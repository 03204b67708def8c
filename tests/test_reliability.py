"""The command in a process of its own: signals, two at once, disks that take no more."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from signal import SIGHUP, SIGINT, SIGKILL, SIGTERM, SIGUSR1
from typing import Any

import pytest

from proposer_rl.runs.checkpoint import load_latest, save_checkpoint
from proposer_rl.runs.process import locked
from tests.commands import SMOKE
from tests.processes import LONGEST, ROOT, Ended, Processes
from tests.same_run import assert_same_run

FEW = [*SMOKE, "schedule.updates=4"]
TRAIN = ["+method=target", *FEW]
ROW = "fsync metrics.csv"


@pytest.fixture(scope="module")
def whole(processes: Processes, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended]:
    folder = tmp_path_factory.mktemp("whole")
    ended = processes(*TRAIN, f"hydra.run.dir={folder}")
    assert ended.code == 0, ended.output
    return folder, ended


@pytest.fixture(scope="module")
def killed(
    whole: tuple[Path, Ended], processes: Processes, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A run that was killed after its first checkpoint."""
    folder = tmp_path_factory.mktemp("killed")
    ended = processes(
        *TRAIN, f"hydra.run.dir={folder}", signal_at={nth(whole[1].writes, ROW, 2): int(SIGKILL)}
    )
    assert ended.code == -SIGKILL
    return folder


@pytest.fixture
def run(killed: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(killed, tmp_path, dirs_exist_ok=True))


def nth(writes: list[str], name: str, n: int) -> int:
    return [i for i, write in enumerate(writes) if write == name][n]


def checkpoints(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "checkpoints").glob("step_*.pt")}


def test_a_signal_saves_and_ends_and_the_same_command_goes_on(
    whole: tuple[Path, Ended], processes: Processes, tmp_path: Path
) -> None:
    """One signal for all of ``tests/runs/test_signals.py``."""
    command = [*TRAIN, f"hydra.run.dir={tmp_path / 'run'}"]
    # With the second row, at update 2; checkpoints by count are at 2 and 4, too.
    stopped = processes(*command, signal_at={nth(whole[1].writes, ROW, 1): int(SIGUSR1)})
    assert stopped.code == 128 + SIGUSR1
    assert "SIGUSR1: saving at the next safe point" in stopped.output
    assert re.search(f"To go on: .*bin/train {re.escape(shlex.join(command))}\n", stopped.output)
    latest = load_latest(tmp_path / "run" / "checkpoints")
    assert latest is not None and latest[1]["updates"] == 2
    assert processes(*command).code == 0
    assert_same_run(whole[0], tmp_path / "run")


LOST = {  # how the output is lost, a signal, the exit code
    "terminal": ({"terminal": True}, None, 128 + SIGHUP),
    "terminal of a disowned run": ({"terminal": True, "ignored": [SIGHUP]}, None, 0),
    "pipe": ({}, None, 0),
    "pipe, Ctrl-C": ({}, SIGINT, 128 + SIGINT),
}


@pytest.mark.parametrize(("how", "signum", "code"), LOST.values(), ids=LOST)
def test_output_that_nobody_reads_any_more_ends_no_run(
    how: dict[str, Any],
    signum: int | None,
    code: int,
    whole: tuple[Path, Ended],
    processes: Processes,
    tmp_path: Path,
) -> None:
    """Terminals that close and readers of pipes that die: skypilot-org/skypilot#1169, SparK#19."""
    command = [*TRAIN, "compute.progress=true", f"hydra.run.dir={tmp_path / 'run'}"]
    row = nth(whole[1].writes, ROW, 1)
    signal_at = {} if signum is None else {row + 1: int(signum)}
    ended = processes(*command, lost_at=row, signal_at=signal_at, **how)
    assert ended.code == code
    latest = load_latest(tmp_path / "run" / "checkpoints")
    assert latest is not None and latest[1]["updates"] == (2 if code else 4)
    assert (tmp_path / "run" / "summary.json").exists() == (code == 0)
    assert processes(*command).code == 0
    assert_same_run(whole[0], tmp_path / "run")


def test_a_disowned_sweep_whose_terminal_closes_finishes_its_runs(
    whole: tuple[Path, Ended], processes: Processes, tmp_path: Path
) -> None:
    sweep = [
        "-m",
        *TRAIN,
        "seed=0,1,2",
        f"hydra.sweep.dir={tmp_path}",
        "hydra.sweep.subdir=${seed}",
    ]
    row = nth(whole[1].writes, ROW, 1)
    ended = processes(*sweep, lost_at=row, terminal=True, ignored=[SIGHUP])
    assert ended.code == 0
    assert len(list(tmp_path.glob("*/summary.json"))) == 3
    assert not list(tmp_path.glob("*/error.json"))
    assert_same_run(whole[0], tmp_path / "0")


def test_ctrl_c_at_a_pipeline_with_tee_saves(tmp_path: Path) -> None:
    """A real one, whose interpreters come to their own ends: Ctrl-C goes to the whole group."""
    command = [sys.executable, "-m", "proposer_rl.cli.start", *TRAIN, "schedule.updates=100000"]
    line = f"{shlex.join(command)} hydra.run.dir=run 2>&1 | tee log; exit ${{PIPESTATUS[0]}}"
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    bash = ["bash", "-c", f"trap : INT; {line}"]
    pipeline = subprocess.Popen(bash, cwd=tmp_path, env=environment, start_new_session=True)
    metrics = tmp_path / "run" / "metrics.csv"
    try:
        while pipeline.poll() is None and not (metrics.exists() and metrics.stat().st_size > 1000):
            time.sleep(0.05)
        os.killpg(pipeline.pid, SIGINT)
        assert pipeline.wait(LONGEST) == 128 + SIGINT
    finally:  # otherwise it would train on, and keep this process's output open
        with suppress(ProcessLookupError):
            os.killpg(pipeline.pid, SIGKILL)
    assert load_latest(tmp_path / "run" / "checkpoints") is not None


def test_a_signal_in_the_proposers_episode_ends_it_and_it_is_played_again(
    processes: Processes, tmp_path: Path
) -> None:
    command = ["+method=perf_gain", *FEW]
    whole = processes(*command, f"hydra.run.dir={tmp_path / 'whole'}")
    # While the first row is written; what follows is the first episode. One is of 3 updates, the
    # other is so long that nobody waits for its end.
    signal_at = {nth(whole.writes, ROW, 0): int(SIGTERM)}
    long = ["proposer.meta_episode_length=100000", "schedule.cycle_length=3"]
    for name, more in (("run", []), ("long", long)):
        run = [*command, *more, f"hydra.run.dir={tmp_path / name}"]
        stopped = processes(*run, signal_at=signal_at)
        assert stopped.code == 128 + SIGTERM, stopped.output
        latest = load_latest(tmp_path / name / "checkpoints")
        assert latest is not None and latest[1]["cycles"] == latest[1]["updates"] == 0
        assert not (tmp_path / name / "cycles.jsonl").exists()
    assert processes(*command, f"hydra.run.dir={tmp_path / 'run'}").code == 0
    assert_same_run(tmp_path / "whole", tmp_path / "run")


def test_a_signal_after_the_last_update_ends_the_sweep(
    whole: tuple[Path, Ended], processes: Processes, tmp_path: Path
) -> None:
    sweep = ["-m", *TRAIN, "seed=0,1", f"hydra.sweep.dir={tmp_path}", "hydra.sweep.subdir=${seed}"]
    signal_at = {nth(whole[1].writes, "fsync levels.jsonl", 0): int(SIGTERM)}
    stopped = processes(*sweep, signal_at=signal_at)
    assert stopped.code == 128 + SIGTERM, stopped.output
    assert (tmp_path / "0" / "summary.json").exists() and not (tmp_path / "1").exists()


def test_a_second_ctrl_c_stops_at_once(
    whole: tuple[Path, Ended], processes: Processes, tmp_path: Path
) -> None:
    command = [*TRAIN, f"hydra.run.dir={tmp_path / 'run'}"]
    row = nth(whole[1].writes, ROW, 1)
    # The second comes with the next write, long before the safe point.
    stopped = processes(*command, signal_at={row: int(SIGINT), row + 1: int(SIGINT)})
    assert stopped.code == 128 + SIGINT
    assert "Stopped at once" in stopped.output
    assert checkpoints(tmp_path / "run") == {}
    assert processes(*command).code == 0
    assert_same_run(whole[0], tmp_path / "run")


def test_a_folder_in_use_is_refused_naming_the_holder(processes: Processes, tmp_path: Path) -> None:
    with locked(tmp_path):
        refused = processes(*TRAIN, f"hydra.run.dir={tmp_path}")
    assert refused.code == 5
    assert f"error: {tmp_path} is in use by process {os.getpid()} on " in refused.output
    assert not (tmp_path / "config.json").exists()


def test_a_full_disk_ends_the_run_and_leaves_the_checkpoint_before(
    whole: tuple[Path, Ended], processes: Processes, run: Path
) -> None:
    """In a folder whose lock a dead process holds, which blocks nobody."""
    with pytest.raises(ProcessLookupError):
        os.kill(json.loads((run / ".holder.json").read_text())["process"], 0)
    command = [*TRAIN, f"hydra.run.dir={run}"]
    before = checkpoints(run)
    assert len(before) == 1
    full = processes(*command, largest_file=20_000)
    assert full.code == 4
    assert full.output.strip().splitlines() == [
        f"error: cannot write {run}/checkpoints/step_000000002.pt: File too large"
    ]
    assert checkpoints(run) == before
    assert processes(*command).code == 0
    assert_same_run(whole[0], run)


def test_numbers_that_go_wrong_end_the_run_and_the_last_good_checkpoint_stays(
    whole: tuple[Path, Ended], processes: Processes, tmp_path: Path
) -> None:
    command = [*TRAIN, f"hydra.run.dir={tmp_path}"]
    processes(*command, signal_at={nth(whole[1].writes, ROW, 1): int(SIGTERM)})
    latest = load_latest(tmp_path / "checkpoints")
    assert latest is not None
    step, state = latest
    for entry in state["solver"].values():
        entry["value"] *= 1e30  # still finite, but their products are not
    save_checkpoint(tmp_path / "checkpoints", step + 1, state)
    before = checkpoints(tmp_path)
    diverged = processes(*command)
    assert diverged.code == 3, diverged.output
    assert re.match(
        r"error: cycle 0, after 2 Solver updates: copy 0: (loss_[a-z]+|grad_norm)"
        r" of gradient step 0 is not finite \(.*\)\n$",
        diverged.output,
    ), diverged.output
    assert checkpoints(tmp_path) == before
