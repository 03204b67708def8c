"""The process of a run: its output, signals that stop it, its folder's lock, what it is doing."""

from __future__ import annotations

import json
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from types import FrameType
from typing import Any, TextIO

from filelock import FileLock, Timeout

from proposer_rl.runs.folder import storage, write_atomically

# Ctrl-C; the polite kill; a closed terminal; what Slurm and submitit send before a job is
# pre-empted or runs out of time. Windows has the first two.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
STOP_SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
PROGRESS = "progress.json"
EVERY = 1.0  # seconds between two writes


class Output:
    """Wraps a text stream so that writing to it never raises.

    A terminal may close, or the reader of a pipe end, while a run has hours to go: what it prints
    is lost then, and nothing else. Characters that the stream's encoding lacks become ``?``.

    Args:
        stream: what is written to; None, as Python has it for a closed descriptor, for nothing.
    """

    def __init__(self, stream: TextIO | None) -> None:
        # The null device takes the closed descriptor's number, which a run's file must not get.
        self._stream = stream or open(os.devnull, "w")  # noqa: SIM115  open as long as the process

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def __eq__(self, other: object) -> bool:
        # So that tqdm knows its stream, and clears the bars on it before it writes a text there.
        return other is self or other is self._stream or NotImplemented

    __hash__ = object.__hash__

    def write(self, text: str) -> int:
        """Writes a text if somebody takes it."""
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        with suppress(OSError, ValueError):
            self._stream.write(text.encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Passes on what a buffer holds if somebody takes it."""
        with suppress(OSError, ValueError):
            self._stream.flush()


def guard_output() -> None:
    """Makes the process's standard output and error streams that never raise."""
    for name in ("stdout", "stderr"):
        if not isinstance(stream := getattr(sys, name), Output):
            setattr(sys, name, Output(stream))


class Interrupted(Exception):
    """The run was asked to stop, and has saved what is needed to go on.

    Args:
        signum: the signal.

    Attributes:
        folder: where the run lies; None where that is not known.
    """

    folder: Path | None = None

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum

    def __str__(self) -> str:
        saved = f"stopped by {signal.Signals(self.signum).name}; all is saved"
        if self.folder is None:
            return saved
        return f"{saved}. The same call with folder={str(self.folder)!r} goes on"

    @property
    def exit_code(self) -> int:
        """The exit code of a process that the signal ends, as in shells."""
        return 128 + self.signum


class StopRequested(Exception):
    """A signal has come during long work, which ends here and can be repeated."""


class StopSignals:
    """A context in which a stop signal is kept until the run comes to a safe point.

    A second SIGINT is not kept: it raises KeyboardInterrupt at once. A signal that is ignored (as
    ``nohup`` has it) stays so. Outside of the main thread nothing is changed, since Python delivers
    signals there only.
    """

    def __init__(self) -> None:
        self._before: dict[int, Any] = {}
        self._pending: int | None = None

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            _shield_tracker()
            for signum in STOP_SIGNALS:
                if signal.getsignal(signum) is not signal.SIG_IGN:
                    self._before[signum] = signal.signal(signum, self._keep)
        return self

    def __exit__(self, *_: object) -> None:
        for signum, handler in self._before.items():
            signal.signal(signum, handler)

    @property
    def pending(self) -> bool:
        """True if a signal has come."""
        return self._pending is not None

    def check(self) -> None:
        """Interrupts long work that can be repeated.

        Raises:
            StopRequested: if a signal has come.
        """
        if self.pending:
            raise StopRequested

    def deliver(self) -> None:
        """Acts on the signal that has come: to be called once all is saved.

        A handler that was there before this context is called, such as submitit's, which puts the
        job into the queue again and exits; if it returns, the run goes on.

        Raises:
            Interrupted: if there was no such handler, or it raises, as submitit's does where a job
                has run out of time too often to be queued again.
        """
        signum, self._pending = self._pending, None
        if signum is None:
            return
        before = self._before[signum]
        if not callable(before) or before is signal.default_int_handler:
            raise Interrupted(signum)
        try:
            before(signum, None)
        except Exception as error:
            raise Interrupted(signum) from error

    def _keep(self, signum: int, frame: FrameType | None) -> None:
        if signum == signal.SIGINT and self._pending == signal.SIGINT:
            raise KeyboardInterrupt
        self._pending = signum
        hint = "; once more: stop at once" if signum == signal.SIGINT else ""
        line = f"\n{signal.Signals(signum).name}: saving at the next safe point{hint}\n"
        with suppress(OSError):  # a closed terminal must not keep the run from being saved
            os.write(2, line.encode())  # print is not safe to enter twice


def _shield_tracker() -> None:
    """Starts Python's resource tracker, if it does not run, with stop signals blocked.

    Slurm signals every process of a step. The tracker, which tqdm's lock brings, would die of most,
    and its successor complain in tracebacks of what it does not know.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows, which has no such tracker
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class InUseError(RuntimeError):
    """Another process works in the folder; the message is one line that names it."""

    exit_code = 5


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keeps other processes out of a folder.

    The operating system gives the lock up when the process ends, in whatever way: a lock of a dead
    process blocks nobody.

    Args:
        folder: where ``.lock`` is made, and ``.holder.json``, which tells others who holds it.

    Raises:
        InUseError: at once, if another process holds it, naming host, process and start.
        StorageError: if the folder cannot be written to.
    """
    path = Path(folder)
    lock = FileLock(path / ".lock")
    with storage(path / ".lock"):
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise InUseError(f"{path} is in use by {_holder(path)}") from None
    try:
        started = time.strftime("%Y-%m-%d %H:%M:%S")
        holder = {"process": os.getpid(), "host": platform.node(), "started": started}
        write_atomically(path / ".holder.json", json.dumps(holder).encode())
        yield
    finally:
        lock.release()


def _holder(folder: Path) -> str:
    try:
        holder = json.loads((folder / ".holder.json").read_text())
        return f"process {holder['process']} on {holder['host']}, started {holder['started']}"
    except (OSError, ValueError, TypeError, KeyError):
        return "another process"  # which has just begun


class Status:
    """Says what a run is doing.

    Args:
        parts: number of parts of the work that is told in parts.
        clock: seconds.
    """

    def __init__(self, parts: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.doing = ""
        self._parts = parts
        self._clock = clock
        self._folder: Path | None = None
        self._told = -EVERY
        self._show: Callable[[], None] = lambda: None

    @contextmanager
    def of_run(self, folder: Path, show: Callable[[], None]) -> Iterator[None]:
        """Reports a run's activity in its folder while inside, and calls ``show`` as often."""
        self._folder, self._show = folder, show
        try:
            yield
        finally:
            self._folder = None
            # A run that is over does nothing, however it ended; and why it did is to be told, not
            # that a file of no worth stays.
            with suppress(OSError):
                (folder / PROGRESS).unlink()

    def tell(self, doing: str, part: int = 0) -> None:
        """Reports what the run does, and how many parts of it are done; 0 where it has none."""
        self.doing = f"{doing} {min(part, self._parts)}/{self._parts}" if part else doing
        now = self._clock()
        if self._folder is None or now - self._told < EVERY:
            return
        self._told = now
        content = json.dumps({"doing": self.doing}).encode()
        write_atomically(self._folder / PROGRESS, content, durably=False)
        self._show()


def processor() -> str:
    """Returns the processor's name, or else its kind."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
