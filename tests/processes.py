"""The command in processes of its own, cheaply: one process imports everything, then forks.

Run as a program, this file is that process. It reads one request per line, forks a child that calls
the command, and answers with how the child ended. It must not compute anything with torch itself,
since threads do not survive a fork.
"""

from __future__ import annotations

import faulthandler
import fcntl
import gc
import json
import os
import resource
import select
import subprocess
import sys
import termios
import time
from dataclasses import dataclass, field
from importlib import import_module
from itertools import count
from pathlib import Path
from signal import SIG_IGN, SIGKILL, signal
from threading import RLock
from typing import Any

from tqdm import tqdm

from proposer_rl.runs.process import PROGRESS

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 200  # seconds; a child that takes longer hangs: it shows where, and ends


@dataclass
class Ended:
    """How a child ended: its exit code, or minus the signal's number; what it said and did.

    ``writes`` names its calls of fsync and replace in order, such as ``"fsync metrics.csv"``. Those
    of ``progress.json`` are no part of it: how many there are, the clock decides.
    """

    code: int
    seconds: float
    output: str
    writes: list[str]


@dataclass
class Request:
    """What the child is to do, and what is done to it.

    Attributes:
        arguments: of the command.
        signals: (seconds after the start, signal).
        signal_at: {index of a write: signal}: before that write the child sends itself a signal. If
            it is SIGKILL and the write is the fsync of a new checkpoint, half of that is there.
        largest_file: bytes; RLIMIT_FSIZE.
        lost_at: index of the write before which nobody reads any more what it says, neither its
            standard output nor its errors. It is a pipe's other end that is closed.
        terminal: it is a terminal that is closed, which hangs up: SIGHUP.
        ignored: signals that it ignores from the start, as after ``nohup`` or ``disown``.
        folder: where the child works.
    """

    arguments: list[str]
    signals: list[tuple[float, int]] = field(default_factory=list)
    signal_at: dict[int, int] = field(default_factory=dict)
    largest_file: int | None = None
    lost_at: int | None = None
    terminal: bool = False
    ignored: list[int] = field(default_factory=list)
    folder: str = "."


class Processes:
    """Starts children of a process that has everything imported."""

    def __init__(self, folder: Path) -> None:
        self._log = folder / "output"
        self._server = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=os.environ
            | {"PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'examples'}", "OMP_NUM_THREADS": "1"},
        )

    def __call__(self, *arguments: str, **options: Any) -> Ended:
        """Call the command and wait for its end."""
        return self.end(self.start(*arguments, **options))

    def start(self, *arguments: str, **options: Any) -> None:
        """Call the command; :meth:`end` waits for it."""
        assert self._server.stdin is not None
        self._server.stdin.write(json.dumps(vars(Request(list(arguments), **options))) + "\n")
        self._server.stdin.flush()

    def end(self, _: None = None) -> Ended:
        """Wait for the child that was started."""
        assert self._server.stdout is not None
        line = self._server.stdout.readline()
        assert line, "the process that forks has died"
        return Ended(**json.loads(line))

    def close(self) -> None:
        """End the process that forks."""
        assert self._server.stdin is not None
        self._server.stdin.close()
        try:
            self._server.wait(LONGEST)
        finally:
            self._server.kill()


def python(
    code: str, *arguments: str, path: Path, folder: Path
) -> subprocess.CompletedProcess[str]:
    """Run some code in a fresh interpreter, with this folder of packages, and read what it says."""
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(path)},
        capture_output=True,
        text=True,
        check=False,
    )


def serve() -> None:
    gc.disable()  # of what is imported nothing is garbage
    from proposer_rl.cli import run, train, watch  # noqa: F401  run takes seconds
    from tests import composing

    # What takes seconds, before the first fork. tensordict loads pandas where there is one.
    for module in ("proposer_rl.tasks.mazes.task", "pandas"):
        import_module(module)
    composing.remember()
    watch.draw_run = lambda folder, title: folder / "run.png"  # a quarter of what a child computes
    gc.freeze()  # a child that looks for garbage would copy all that memory
    gc.enable()

    for line in sys.stdin:
        values = json.loads(line)
        values["signal_at"] = {int(k): v for k, v in values["signal_at"].items()}
        request = Request(**values)
        composing.prepare(tuple(given[1:] for given in request.arguments if given[0] == "+"))
        print(json.dumps(vars(_fork(request))), flush=True)


def _fork(request: Request) -> Ended:
    said, counted = os.memfd_create("output"), os.memfd_create("writes")
    reader, writer = os.openpty() if request.terminal else os.pipe()
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _become_child(request, said if request.lost_at is None else writer, counted)
    os.close(writer)
    if request.lost_at is not None:
        while _writes(counted)[request.lost_at :] == [] and not _has_ended(child):
            time.sleep(0.001)
    os.close(reader)
    for delay, signum in request.signals:
        while time.monotonic() - started < delay and not _has_ended(child):
            time.sleep(0.001)
        if not _has_ended(child):
            os.kill(child, signum)
    _, status = os.waitpid(child, 0)
    seconds = time.monotonic() - started
    writes = _writes(counted)
    output = os.pread(said, 1 << 20, 0).decode()
    os.close(said)
    os.close(counted)
    return Ended(os.waitstatus_to_exitcode(status), seconds, output, writes)


def _writes(counted: int) -> list[str]:
    return os.pread(counted, 1 << 20, 0).decode().splitlines()


def _has_ended(child: int) -> bool:
    """Whether the child waits to be waited for; it stays so that its number is not used again."""
    return os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _become_child(request: Request, said: int, counted: int) -> None:
    from proposer_rl.cli import train

    code = 1
    try:
        for signum in request.ignored:
            signal(signum, SIG_IGN)
        if request.terminal:
            os.setsid()
            fcntl.ioctl(said, termios.TIOCSCTTY, 0)
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.close(said)
        faulthandler.dump_traceback_later(LONGEST, exit=True, file=2)
        os.chdir(request.folder)
        _note_writes(request.signal_at, request.lost_at, counted)
        if request.largest_file is not None:
            limit = (request.largest_file, request.largest_file)
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        tqdm.set_lock(RLock())  # its own would be shared with other processes
        sys.argv = ["proposer-train", *request.arguments]
        train.main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _note_writes(signal_at: dict[int, int], lost_at: int | None, noted: int) -> None:
    """Write a line to ``noted`` for every fsync and replace, and signal at some of them.

    At ``lost_at`` it waits until nobody reads what the process says.
    """
    originals = {name: getattr(os, name) for name in ("fsync", "replace")}
    indices = count()

    def call(name: str, file: Any, *arguments: Any) -> Any:
        path = Path(os.readlink(f"/proc/self/fd/{file}") if name == "fsync" else str(file))
        if path.name != f".{PROGRESS}.tmp":
            os.write(noted, f"{name} {path.name}\n".encode())
            index = next(indices)
            if index == lost_at:
                hung_up = select.poll()
                hung_up.register(1, 0)
                hung_up.poll()
            signum = signal_at.get(index)
            if signum is not None:
                if signum == SIGKILL and name == "fsync" and path.name.startswith(".step_"):
                    os.ftruncate(file, os.fstat(file).st_size // 2)
                os.kill(os.getpid(), signum)
        return originals[name](file, *arguments)

    for name in originals:
        setattr(os, name, lambda *arguments, name=name: call(name, *arguments))


if __name__ == "__main__":
    serve()
