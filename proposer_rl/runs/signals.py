"""Signals that ask a run to stop: it saves first, and can go on later."""

from __future__ import annotations

import os
import signal
import threading
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any

# Ctrl-C; the polite kill; a closed terminal; what Slurm and submitit send before a job is
# pre-empted or runs out of time.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)


class Interrupted(Exception):
    """The run was asked to stop, and has saved what is needed to go on.

    Attributes:
        signum: the signal.
    """

    def __init__(self, signum: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}")
        self.signum = signum

    @property
    def exit_code(self) -> int:
        """That of a process which the signal ends, as shells have it."""
        return 128 + self.signum


class StopRequested(Exception):
    """A signal has come during long work, which ends here and can be repeated."""


class StopSignals:
    """Inside this context a stop signal is kept until the run comes to a safe point.

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
        """Whether a signal has come."""
        return self._pending is not None

    def check(self) -> None:
        """Interrupt long work that can be repeated.

        Raises:
            StopRequested: if a signal has come.
        """
        if self.pending:
            raise StopRequested

    def deliver(self) -> None:
        """Act on the signal that has come: to be called once all is saved.

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
        os.write(2, line.encode())  # print is not safe to enter twice


def _shield_tracker() -> None:
    """Start Python's resource tracker with stop signals blocked for good, unless it runs already.

    Slurm signals every process of a step. The tracker, which tqdm's lock brings, would die of most,
    and its successor complain in tracebacks of what it does not know.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        resource_tracker.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
