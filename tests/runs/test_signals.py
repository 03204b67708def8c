"""Handlers of stop signals; runs that get them are in test_reliability.py."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import proposer_rl
from proposer_rl.experiment import Experiment
from proposer_rl.runs.process import STOP_SIGNALS, Interrupted, StopSignals
from tests.processes import LONGEST, ROOT, python
from tests.same_run import assert_same_run


def send(signum: int) -> None:
    os.kill(os.getpid(), signum)


@pytest.fixture(autouse=True)
def _as_before():
    before = {signum: signal.getsignal(signum) for signum in STOP_SIGNALS}
    yield
    assert {signum: signal.getsignal(signum) for signum in STOP_SIGNALS} == before


@contextmanager
def handled(signum: int, handler: Any) -> Iterator[StopSignals]:
    """Stop signals where another handler was before."""
    before = signal.signal(signum, handler)
    try:
        with StopSignals() as signals:
            yield signals
    finally:
        signal.signal(signum, before)


@pytest.mark.parametrize("signum", STOP_SIGNALS)
def test_a_signal_is_kept_until_it_is_delivered(signum: int, capfd) -> None:
    with StopSignals() as signals:
        signals.deliver()
        assert not signals.pending
        send(signum)
        assert signals.pending
        assert f"{signum.name}: saving at the next safe point" in capfd.readouterr().err
        with pytest.raises(
            Interrupted, match=f"^stopped by {signum.name}; all is saved$"
        ) as caught:
            signals.deliver()
        assert caught.value.signum == signum
        assert not signals.pending


def test_a_second_sigint_is_not_kept() -> None:
    with StopSignals() as signals:
        send(signal.SIGTERM)
        send(signal.SIGTERM)
        send(signal.SIGINT)
        assert signals.pending
        with pytest.raises(KeyboardInterrupt):
            send(signal.SIGINT)


def test_a_job_that_is_not_queued_again_is_interrupted() -> None:
    """Submitit's handler raises where a job has run out of time too often."""

    def refuse(*_: object) -> None:
        raise RuntimeError("Job not requeued because: timed-out too many times.")

    with handled(signal.SIGUSR2, refuse) as signals:
        send(signal.SIGUSR2)
        with pytest.raises(Interrupted, match="stopped by SIGUSR2"):
            signals.deliver()


def test_a_handler_from_before_acts_after_the_checkpoint_and_may_let_the_run_go_on() -> None:
    """As submitit's does: it queues the job again and exits, or ignores SIGTERM."""
    acted: list[int] = []
    with handled(signal.SIGUSR2, lambda signum, _: acted.append(signum)) as signals:
        send(signal.SIGUSR2)
        assert signals.pending and acted == []
        signals.deliver()
        assert not signals.pending and acted == [signal.SIGUSR2]


def test_an_ignored_signal_stays_ignored() -> None:
    with handled(signal.SIGHUP, signal.SIG_IGN) as signals:
        send(signal.SIGHUP)
        assert not signals.pending


def test_a_stopped_call_says_that_all_is_saved_and_how_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From Python, in a folder that nobody has named."""
    monkeypatch.chdir(tmp_path)
    few = {"scale": "smoke", "updates": 2, "progress": False}
    measure = Experiment._measure

    def stopped(run: Experiment) -> None:
        send(signal.SIGINT)
        measure(run)

    with monkeypatch.context() as patched, pytest.raises(Interrupted) as caught:
        patched.setattr(Experiment, "_measure", stopped)
        proposer_rl.train("maze", "target", **few)
    folder = caught.value.folder
    assert folder is not None and str(caught.value) == (
        f"stopped by SIGINT; all is saved. To resume, call again with folder={str(folder)!r}"
    )
    proposer_rl.train("maze", "target", **few, folder=folder)
    proposer_rl.train("maze", "target", **few, folder="whole")
    assert_same_run(Path("whole"), folder)


WITHOUT = """
import multiprocessing.resource_tracker as tracker, os, signal, torchrl.data
tracker._HAVE_SIGMASK = False
for name in ("SIGHUP", "SIGUSR1", "SIGUSR2", "pthread_sigmask"):
    delattr(signal, name)
del os.sysconf
opened = os.open
def no_folders(path, *flags):
    if os.path.isdir(path):
        raise PermissionError(13, "Permission denied")
    return opened(path, *flags)
os.open = no_folders
import proposer_rl as prl
space = prl.Parameters({"gravity": (5.0, 25.0)})
teacher = prl.Teacher(prl.curricula.domain_randomization(), space)
ticket, level = teacher.ask()
teacher.tell(ticket, return_=1.0)
run = prl.train("maze", "target", scale="smoke", updates=1, folder="run", progress=False)
print(run.summary["updates"])
"""


def test_a_system_with_few_signals_has_teachers_and_runs(tmp_path: Path) -> None:
    """Windows, as far as it can be imitated: crewAIInc/crewAI#4062."""
    ended = python(WITHOUT, path=ROOT, folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[-1] == "1"
    assert ended.stderr.count("folders cannot be synced here") == 1


GONE = """
import os, random, sys
import numpy, proposer_rl as prl, torch
os.close(int(sys.argv[1]))  # the other end of the pipe
def state():
    numpys = numpy.random.get_state()[1].tolist()
    return random.getstate(), numpys, torch.get_rng_state().tolist()
before = state()
run = prl.train("maze", "target", scale="smoke", updates=2, folder="run")
os._exit(0 if run.summary["updates"] == 2 and state() == before else 1)
"""


def test_a_call_whose_output_nobody_reads_comes_to_its_end_and_draws_nothing(
    tmp_path: Path,
) -> None:
    """From the caller's generators, nor do the modules that it imports."""
    reader, writer = os.pipe()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    child = subprocess.Popen(
        [sys.executable, "-c", GONE, str(reader)],
        cwd=tmp_path,
        env=environment,
        stdout=writer,
        stderr=writer,
        pass_fds=[reader],
    )
    os.close(reader)
    os.close(writer)
    try:
        assert child.wait(LONGEST) == 0
    finally:
        child.kill()


def test_other_threads_change_nothing() -> None:
    handlers = []

    def enter() -> None:
        with StopSignals():
            handlers.append([signal.getsignal(signum) for signum in STOP_SIGNALS])

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert handlers == [[signal.getsignal(signum) for signum in STOP_SIGNALS]]


SHIELDED = """
import os, time
from multiprocessing import Lock, resource_tracker
from proposer_rl.runs.process import STOP_SIGNALS, StopSignals
with StopSignals():
    Lock()
    for signum in STOP_SIGNALS:
        os.kill(resource_tracker._resource_tracker._pid, signum)
    time.sleep(0.2)
    print(os.waitpid(resource_tracker._resource_tracker._pid, os.WNOHANG))
"""


def test_the_resource_tracker_outlives_what_slurm_sends_to_all(tmp_path: Path) -> None:
    ended = python(SHIELDED, path=ROOT, folder=tmp_path)
    assert (ended.stdout, ended.stderr) == ("(0, 0)\n", "")
