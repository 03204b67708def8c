"""The command with workers, in processes of its own: killed, resumed, and without a cluster."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from signal import SIGKILL

import pytest

from proposer_rl.runs.checkpoint import load_latest
from proposer_rl.runs.folder import read_csv
from tests.processes import Processes

COMMAND = ["+method=perf_gain", "+scale=smoke", "proposer.rollouts=2", "compute.progress=false"]
MULTIPROCESS = ["compute.collector=multiprocess", "compute.workers=1"]


def working_in(folder: Path) -> list[str]:
    """The processes whose working folder it is."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if (process / "cwd").readlink() == folder:
                found.append(process.name)
        except OSError:  # it has ended
            continue
    return found


@pytest.mark.slow
def test_killed_with_its_worker_and_resumed_it_is_the_run_that_was_not(
    processes: Processes, tmp_path: Path
) -> None:
    run = f"hydra.run.dir={tmp_path / 'run'}"
    # In one process: the same writes, and the same numbers but for rounding.
    whole = processes(*COMMAND, f"hydra.run.dir={tmp_path / 'whole'}")
    assert whole.code == 0, whole.output
    # With the second cycle's line: its episode is over, and no checkpoint knows of it.
    at = [i for i, name in enumerate(whole.writes) if name == "fsync cycles.jsonl"][1]
    folder = tmp_path / "works_here"
    folder.mkdir()
    killed = processes(
        *COMMAND, *MULTIPROCESS, run, signal_at={at: int(SIGKILL)}, folder=str(folder)
    )
    assert killed.code == -SIGKILL, killed.output
    # Nobody can tell its worker: it sees it for itself, and ends.
    while working_in(folder):
        time.sleep(0.2)
    latest = load_latest(tmp_path / "run" / "checkpoints")
    assert latest is not None and latest[1]["cycles"] == 1
    ended = processes(*COMMAND, *MULTIPROCESS, run)
    assert ended.code == 0, ended.output
    for name in ("metrics.csv", "training.csv"):
        rows = (read_csv(folder / name) for folder in (tmp_path / "whole", tmp_path / "run"))
        for one, other in zip(*rows, strict=True):
            assert {**one, "seconds": 0} == pytest.approx({**other, "seconds": 0}, abs=1e-4)


def test_without_the_cluster_one_line_and_exit_code_6(
    train: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ray = ["compute.collector=ray", "compute.workers=2", "compute.ray_address=127.0.0.1:1"]
    assert train(*COMMAND, *ray, f"hydra.run.dir={tmp_path}") == 6
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: compute.ray_address=127.0.0.1:1: no cluster answers there: ")
