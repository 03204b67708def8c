"""The process of a run: its output, stop signals, the lock of its folder, and its status."""

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

# Ctrl-C; kill; a closed terminal; two that Slurm and submitit send before a job is pre-empted or
# runs out of time. Windows has only the first two.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
STOP_SIGNALS = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))
EVERY = 1.0  # seconds between two reports that are shown


class Output:
    """Wraps a text stream so that writing to it never raises.

    If the terminal closes or the reader of a pipe ends, a run that has hours to go continues, and
    only its output is lost. Characters that the stream's encoding lacks become ``?``.

    Args:
        stream: the stream; None, which Python has for a closed descriptor, discards the output.
    """

    def __init__(self, stream: TextIO | None) -> None:
        # The null device takes the number of the closed descriptor, so that no file of a run does.
        self._stream = stream or open(os.devnull, "w")  # noqa: SIM115  open until the process ends

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def __eq__(self, other: object) -> bool:
        # So that tqdm recognizes its stream, and clears its bars before it writes a text.
        return other is self or other is self._stream or NotImplemented

    __hash__ = object.__hash__

    def write(self, text: str) -> int:
        """Writes a text, or discards it if that is not possible."""
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        with suppress(OSError, ValueError):
            self._stream.write(text.encode(encoding, "replace").decode(encoding))
        return len(text)

    def flush(self) -> None:
        """Passes on what a buffer holds if somebody takes it."""
        with suppress(OSError, ValueError):
            self._stream.flush()


def guard_output() -> None:
    """Wraps standard output and standard error so that writing to them never raises."""
    for name in ("stdout", "stderr"):
        if not isinstance(stream := getattr(sys, name), Output):
            setattr(sys, name, Output(stream))


class Interrupted(Exception):
    """The run was asked to stop, and has saved a checkpoint.

    Args:
        signum: the signal.

    Attributes:
        folder: of the run; None if it is not known.
    """

    folder: Path | None = None

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum

    def __str__(self) -> str:
        saved = f"stopped by {signal.Signals(self.signum).name}; all is saved"
        if self.folder is None:
            return saved
        return f"{saved}. To resume, call again with folder={str(self.folder)!r}"

    @property
    def exit_code(self) -> int:
        """The exit code that shells give to a process that the signal ends."""
        return 128 + self.signum


class StopRequested(Exception):
    """A signal has come during long work, which is abandoned and can be repeated."""


class StopSignals:
    """A context that keeps a stop signal until the run reaches a safe point.

    A second SIGINT raises KeyboardInterrupt at once. Signals that are ignored, as under ``nohup``,
    stay ignored. Outside of the main thread the context changes nothing, since Python delivers
    signals only to the main thread.
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
        """Whether a signal has come."""
        return self._pending is not None

    def check(self) -> None:
        """Interrupts long work that can be repeated.

        Raises:
            StopRequested: if a signal has come.
        """
        if self.pending:
            raise StopRequested

    def deliver(self) -> None:
        """Acts on the signal that has come, if any; call it when a checkpoint has been saved.

        If there was a handler before this context, it is called, such as submitit's, which puts the
        job into the queue again and exits. If the handler returns, the run continues.

        Raises:
            Interrupted: if there was no handler, or it raises, as submitit's does if a job has run
                out of time too often to be queued again.
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
        with suppress(OSError):  # the terminal may be closed
            os.write(2, line.encode())  # print is not reentrant


def _shield_tracker() -> None:
    """Starts Python's resource tracker with stop signals blocked, unless it is running.

    Slurm signals all processes of a step, and most signals would end the tracker, which tqdm's lock
    starts; its successor would print tracebacks about resources that it does not know.
    """
    if not hasattr(signal, "pthread_sigmask"):  # on Windows, which has no tracker
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class InUseError(RuntimeError):
    """Another process is working in the folder; the message is one line that names it."""

    exit_code = 5


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Locks a folder against other processes.

    The operating system releases the lock when the process ends, even if it is killed.

    Args:
        folder: gets a ``.lock``, and a ``.holder.json`` that says who holds it.

    Raises:
        InUseError: at once, if another process holds the lock, naming host, process and start.
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
        return "another process"  # which has not written the file yet


class Status:
    """Shows what a run is doing, at most once a second.

    Args:
        parts: number of parts in work that is reported in parts.
        clock: returns seconds.

    Attributes:
        doing: what was reported last.
        show: is called after a report.
    """

    def __init__(self, parts: int = 1, clock: Callable[[], float] = time.monotonic) -> None:
        self.doing = ""
        self.show: Callable[[], None] = lambda: None
        self._parts, self._clock = parts, clock
        self._told = -EVERY

    def tell(self, doing: str, part: int = 0) -> None:
        """Reports what the run is doing, and how many parts of it are done, if it has parts."""
        self.doing = f"{doing} {min(part, self._parts)}/{self._parts}" if part else doing
        now = self._clock()
        if now - self._told >= EVERY:
            self._told = now
            self.show()


def processor() -> str:
    """Returns the processor's name, or its architecture if that is not known."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
