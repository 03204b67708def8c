"""One process at a time in a run's folder."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from proposer_rl.runs.folder import storage, write_atomically


class InUseError(RuntimeError):
    """Another process works in the folder; the message is one line that names it."""

    exit_code = 5


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Keep other processes out of a folder.

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
