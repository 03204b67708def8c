"""Runs under a real Slurm of one node: a sweep, time-outs, preemption and ``scancel``.

``bin/research slurm FOLDER``, as root, after ``apt-get install slurm-wlm munge``, starts munge, the
controller and the node's daemon for itself, below FOLDER, and ends them again. It takes some
minutes, since Slurm counts time limits in whole ones, and is no part of the tests.
"""

from __future__ import annotations

import argparse
import os
import re
import secrets
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from proposer_rl.cli.errors import command, number
from proposer_rl.runs.checkpoint import CheckpointError, load_latest
from proposer_rl.runs.folder import read_csv

START = [sys.executable, "-m", "proposer_rl.cli.start"]
SMALL = ["+scale=smoke", "compute.threads=1", "compute.progress=false"]
WORKERS = ["compute.collector=multiprocess", "compute.workers=2"]
SUBMIT = ["hydra/launcher=submitit_slurm", "hydra.launcher.timeout_min=2"]
LOST = "Traceback"
SPARSE = ["schedule.evaluate_every=20", "schedule.checkpoint_every=10"]
TRIED = 50  # updates, to see how long they take
PATIENCE = 1800.0  # seconds

CONF = """
ClusterName=one
SlurmctldHost={host}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
SlurmctldPort={port}
SlurmdPort={next_port}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
KillWait=60
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
NodeName={host} CPUs={cpus} RealMemory={memory}
PartitionName=low Nodes=ALL Default=YES PriorityTier=1 PreemptMode=REQUEUE GraceTime=60
PartitionName=high Nodes=ALL PriorityTier=10 PreemptMode=OFF
"""
SCRIPT = """#!/bin/bash
#SBATCH --exclusive --requeue --open-mode=append
srun {run}
code=$?
if [ $code -gt 128 ]; then scontrol requeue $SLURM_JOB_ID; fi
exit $code
"""


@contextmanager
def cluster(folder: Path) -> Iterator[None]:
    """A Slurm of one node; commands find it by SLURM_CONF while the context lasts."""
    for name in ("state", "spool", "munge"):
        (folder / name).mkdir(parents=True)
    folder.chmod(0o755)
    key, conf = folder / "munge" / "key", folder / "slurm.conf"
    key.write_bytes(secrets.token_bytes(1024))
    key.chmod(0o400)
    here = said("slurmd", "-C")
    cpus, memory = (re.findall(rf"{name}=(\d+)", here)[0] for name in ("CPUs", "RealMemory"))
    port = _free_port()
    conf.write_text(
        CONF.format(
            host=socket.gethostname(),
            folder=folder,
            port=port,
            next_port=port + 1,
            cpus=cpus,
            memory=memory,
        )
    )
    os.environ["SLURM_CONF"] = str(conf)
    munge = [f"--{name}-file={folder}/munge/{name}" for name in ("key", "pid", "seed", "log")]
    daemons = [
        ["munged", "-F", "--force", f"--socket={folder}/munge.socket", *munge],
        ["slurmctld", "-D", "-L", f"{folder}/slurmctld.log"],
        ["slurmd", "-D", "-L", f"{folder}/slurmd.log"],
    ]
    with ExitStack() as stack, (folder / "daemons.log").open("wb") as log:
        for daemon in daemons:
            process = subprocess.Popen(daemon, stdout=log, stderr=log)
            stack.callback(_end, process)
            time.sleep(1)
        until(lambda: "idle" in said("sinfo", "-h", "-o", "%t"), "the node is idle")
        yield


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("", 0))
        return int(one.getsockname()[1])


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    process.wait()


def said(*words: str) -> str:
    """What a command prints."""
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout


def until(holds: Callable[[], Any], what: str) -> None:
    """Wait for something.

    Raises:
        TimeoutError: if it does not come to be.
    """
    end = time.monotonic() + PATIENCE
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError(f"waited for {PATIENCE:.0f} seconds: {what}")
        time.sleep(0.5)


class Checks:
    """What was found, a line each."""

    def __init__(self) -> None:
        self.failed = 0

    def __call__(self, what: str, holds: object) -> None:
        """Say whether something holds."""
        self.failed += not holds
        print(f"{'ok    ' if holds else 'FAILED'} {what}", flush=True)


def run(folder: Path, *settings: str) -> list[str]:
    """The command of a run of its own."""
    return [*START, *SMALL, f"hydra.run.dir={folder}", *settings]


def finish(words: Sequence[str]) -> None:
    """Carry a run out without Slurm."""
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


def submit(folder: Path, partition: str, words: Sequence[str]) -> str:
    """Send a job script of one's own; returns the job's number."""
    script = folder / f"{partition}.sh"
    script.write_text(SCRIPT.format(run=" ".join(words)))
    log = f"--output={folder}/%j.log"
    return said("sbatch", "--parsable", f"--partition={partition}", log, str(script)).strip()


def over(job: str) -> bool:
    """Whether a job is no longer in the queue."""
    return not said("squeue", "-h", "-j", job, "-o", "%T").strip()


def updates(folder: Path) -> int:
    """How many updates the newest checkpoint of a run has."""
    try:
        latest = load_latest(folder / "checkpoints")
    except CheckpointError:
        return 0
    return 0 if latest is None else int(latest[1]["updates"])


def same(one: Path, other: Path) -> bool:
    """Whether two runs measured the same, to the last digit."""
    tables = []
    for folder in (one, other):
        names = ("metrics.csv", "training.csv")
        tables.append([[{**row, "seconds": 0} for row in read_csv(folder / n)] for n in names])
    return repr(tables[0]) == repr(tables[1])


def sweep(folder: Path, long: Sequence[str], check: Checks) -> None:
    """Four runs as four jobs; the same command again has nothing to do."""
    words = ["-m", "+method=target,domain_randomization", "seed=0,1", *SMALL, *SUBMIT]
    words = [*START, *words, "hydra.launcher.timeout_min=30", f"hydra.sweep.dir={folder}/sweep"]
    first = subprocess.run(words, capture_output=True, text=True, check=False)
    check("a sweep: four runs finish", first.returncode == 0 and "4 finished" in first.stdout)
    again = subprocess.run(words, capture_output=True, text=True, check=False)
    check("the same command again finds them finished", again.returncode == 0)


def timeout(folder: Path, long: Sequence[str], check: Checks) -> None:
    """A limit of two minutes is too short: interrupted, or queued again until the run is done."""
    words = ["-m", "+method=target", *SMALL, *SUBMIT, *long, "hydra.launcher.signal_delay_s=30"]
    words = [*START, *words, f"hydra.sweep.dir={folder}/timeout"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    text = ended.stdout + ended.stderr
    check(f"a time-out ends as interrupted ({ended.returncode})", ended.returncode > 128)
    check("... and without a traceback", LOST not in text)
    (place,) = (path.parent for path in (folder / "timeout").rglob("metrics.csv"))
    before = updates(place)
    again = [*words, "hydra.launcher.max_num_timeout=50"]
    ended = subprocess.run(again, capture_output=True, text=True, check=False)
    check("queued again it finishes", ended.returncode == 0)
    check(f"... from update {before} on, to the same bytes", same(place, folder / "whole"))


def preemption(folder: Path, long: Sequence[str], check: Checks) -> None:
    """A job of higher priority takes the node; the run goes on after it."""
    mine = folder / "preempted"
    job = submit(folder, "low", run(mine, "+method=target", *long))
    until(lambda: updates(mine), "a checkpoint")
    other = submit(folder, "high", ["sleep", "5"])
    until(lambda: over(other), "the other job's end")
    before = updates(mine)
    until(lambda: over(job), "the run's end")
    log = (folder / f"{job}.log").read_text()
    check("preemption: saved first, without a traceback", "is saved" in log and LOST not in log)
    check(f"... from update {before} on, to the same bytes", same(mine, folder / "whole"))


def cancel(folder: Path, long: Sequence[str], check: Checks) -> None:
    """``scancel`` signals every process of the step, workers too."""
    mine = folder / "cancelled"
    words = run(mine, "+method=perf_gain", *long, *WORKERS)
    job = submit(folder, "low", words)
    until(lambda: updates(mine), "a checkpoint")
    said("scancel", job)
    until(lambda: over(job), "the job's end")
    log = (folder / f"{job}.log").read_text()
    check("scancel: saved first, without a traceback", "is saved" in log and LOST not in log)


PARTS = {part.__name__: part for part in (sweep, timeout, preemption, cancel)}


def main() -> None:
    """Entry point; 1 if something does not hold."""
    parser = argparse.ArgumentParser(prog="bin/research slurm", description=__doc__)
    parser.add_argument("folder", type=Path, help="a new one; Slurm's and the runs' files")
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="default: all")
    parser.add_argument("--seconds", type=number(float, 1), default=150.0, help="of a run (150)")
    options = parser.parse_args()
    parts = options.parts or list(PARTS)
    command(lambda: _answer(options.folder.resolve(), parts, options.seconds))


def _answer(folder: Path, parts: Sequence[str], seconds: float) -> None:
    missing = [name for name in ("munged", "slurmctld", "slurmd") if not shutil.which(name)]
    if missing or os.getuid():
        sys.exit("error: needs root, and Slurm: apt-get install slurm-wlm munge")
    check = Checks()
    with cluster(folder):
        long = _taking(folder / "tried", seconds)
        finish(run(folder / "whole", "+method=target", *long))
        for name in parts:
            PARTS[name](folder, long, check)
    if check.failed:
        sys.exit(1)


def _taking(folder: Path, seconds: float) -> list[str]:
    """The settings of a run that takes about so long on this machine."""
    finish(run(folder, "+method=target", f"schedule.updates={TRIED}"))
    first, *_, last = read_csv(folder / "metrics.csv")
    each = (last["seconds"] - first["seconds"]) / TRIED
    updates = 20 * round(seconds / each / 20)
    return [f"schedule.updates={updates}", *SPARSE]


if __name__ == "__main__":
    main()
