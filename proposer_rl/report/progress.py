"""How far runs and sweeps are, read from their folders without disturbing them."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from proposer_rl.report.reading import UnreadableRun, begun, read_run
from proposer_rl.report.runs import Run
from proposer_rl.runs.folder import FAILURE
from proposer_rl.runs.records import LONGEST_TEXT, printable, small_json
from proposer_rl.runs.status import FILE

STOPPED = 128  # a greater exit code is that of a signal: the run can go on


def duration(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


@dataclass(frozen=True)
class Progress:
    """The state of one run's folder.

    Attributes:
        folder: of the run.
        runs: its seeds; empty if it has not measured anything yet, or failed before.
        failure: why it failed, in one line; empty if it did not.
        age: seconds since something was written.
        activity: what it was doing then, and how long the rest takes; empty if it does not say or
            has failed.
    """

    folder: Path
    runs: tuple[Run, ...]
    failure: str
    age: float
    activity: str = ""

    @property
    def state(self) -> str:
        """In a word: failed, finished, unfinished (running or interrupted) or starting."""
        if self.failure:
            return "failed"
        if not self.runs:
            return "starting"
        return "finished" if all(run.finished for run in self.runs) else "unfinished"


def read_progress(folder: Path) -> Progress:
    """The state of a run's folder, whatever of it is there yet."""
    failure = _failure(folder)
    try:
        runs = tuple(read_run(folder))
    except UnreadableRun as error:
        runs = ()
        if not failure and (folder / "metrics.csv").is_file():
            failure = printable(str(error).removeprefix(f"{folder}: "))
    activity = "" if failure else _doing(folder)
    if activity and runs:
        activity = ", ".join(filter(None, [activity, _left(runs[0])]))
    return Progress(folder, runs, failure, _age(folder), activity)


def find_progress(folder: Path) -> list[Progress]:
    """The states of all runs in a folder, or of the folder itself."""
    found = [read_progress(path) for path in begun(folder)]
    if not found:
        raise UnreadableRun(f"{folder}: no run in it, finished or begun")
    return found


def _failure(folder: Path) -> str:
    if not (folder / FAILURE).is_file():
        return ""
    match small_json(folder / FAILURE):
        case {"exit_code": int(code)} if code > STOPPED:
            return ""
        case {"message": message}:
            return printable(str(message))[:LONGEST_TEXT]
    return f"{FAILURE} cannot be read"


def _doing(folder: Path) -> str:
    """What a run says that it is doing; empty where it is over or the file cannot be read."""
    match small_json(folder / FILE, 2**12):
        case {"doing": str(text)}:
            return printable(text)[:LONGEST_TEXT]
    return ""


def _left(run: Run) -> str:
    """How long the rest takes if each update takes as long as those so far; empty before one."""
    if not run.updates or run.planned is None:
        return ""
    rest = run.last("seconds") / run.updates * (run.planned - run.updates)
    since = time.time() - (run.folder / "metrics.csv").stat().st_mtime
    return f"about {duration(max(rest - since, 0.0))} left"


def _age(folder: Path) -> float:
    times = []
    for entry in os.scandir(folder):
        with suppress(FileNotFoundError):  # its temporary name is gone once a file is written
            if entry.is_file():
                times.append(entry.stat().st_mtime)
    return max(time.time() - max(times), 0.0) if times else 0.0
