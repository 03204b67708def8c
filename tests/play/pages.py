"""Runs of seconds, and their pages: a server in a thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from time import sleep
from typing import NamedTuple

from proposer_rl.cli.play import open_session
from proposer_rl.play.server import application, listen, server
from tests.tiny import EXAMPLES

TOKEN = "a-token-of-the-tests"
VIEWS = [
    *("task=view_maze_smoke", "+method=target", "compute.progress=false"),
    *("schedule.updates=4", "schedule.keep_checkpoints=100"),
]
CARS = [
    *("--config-dir", f"{EXAMPLES}/conf", "task=mountain_car", "+method=target"),
    *("compute.progress=false", "schedule.updates=4", "schedule.checkpoint_every=2"),
    *("task.levels=8", "solver.ppo.horizon=10", "schedule.keep_checkpoints=100"),
]


class Page(NamedTuple):
    """The page of a run: its server's port, its address, and the run's folder."""

    port: int
    address: str
    run: Path


def files(folder: Path) -> dict[Path, tuple[int, int]]:
    # Hydra has set this process's logging up to go into a file of the run.
    found = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".log"]
    return {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in found}


@contextmanager
def served(run: Path) -> Iterator[Page]:
    """The page of a run; whoever asked whatever, the run's folder is as it was."""
    before = files(run)
    with listen(0) as listening:
        port = listening.getsockname()[1]
        running = server(application(open_session(run), TOKEN))
        # One that hangs must not keep the tests from their end.
        thread = Thread(target=running.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        while not running.started and thread.is_alive():
            sleep(0.01)
        try:
            yield Page(port, f"http://127.0.0.1:{port}/{TOKEN}/", run)
        finally:
            running.should_exit = True
            thread.join(60)
            assert not thread.is_alive()
    assert files(run) == before
