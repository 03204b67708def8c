"""The state of runs and sweeps: a table in characters with a small curve for each run."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from proposer_rl.report.reading import UnreadableRun, begun, read_run
from proposer_rl.report.runs import Run
from proposer_rl.runs.folder import FAILURE, is_rate
from proposer_rl.runs.process import PROGRESS
from proposer_rl.runs.records import LONGEST_TEXT, Column, printable, small_json, words

BLOCKS = " ▁▂▃▄▅▆▇█"
COLOURS = {"finished": "green", "failed": "red", "unfinished": "yellow", "starting": "blue"}
WIDTH = 16  # characters of a curve
STOPPED = 128  # a greater exit code is that of a signal: the run can go on


def duration(seconds: float) -> str:
    """Returns seconds as text in the unit that reads best."""
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
        """The state in a word: failed, finished, unfinished (or running), or starting."""
        if self.failure:
            return "failed"
        if not self.runs:
            return "starting"
        return "finished" if all(run.finished for run in self.runs) else "unfinished"


def read_progress(folder: Path) -> Progress:
    """Returns the state of a run's folder, also of one without measurements."""
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
    return Progress(folder, runs, failure, _seconds_since(folder), activity)


def find_progress(folder: Path) -> list[Progress]:
    """Returns the states of all runs in a folder, or of the folder itself."""
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
    """Returns a run's present activity; empty where it is over or the file cannot be read."""
    match small_json(folder / PROGRESS, 2**12):
        case {"doing": str(text)}:
            return printable(text)[:LONGEST_TEXT]
    return ""


def _left(run: Run) -> str:
    """Returns how long the rest takes at the mean speed so far; empty before the first update."""
    if not run.updates or run.planned is None:
        return ""
    rest = run.last("seconds") / run.updates * (run.planned - run.updates)
    since = time.time() - (run.folder / "metrics.csv").stat().st_mtime
    return f"about {duration(max(rest - since, 0.0))} left"


def _seconds_since(folder: Path) -> float:
    """Returns how long ago something in a folder was written; 0 where it is empty."""
    times = []
    for entry in os.scandir(folder):
        with suppress(FileNotFoundError):  # its temporary name is gone once a file is written
            if entry.is_file():
                times.append(entry.stat().st_mtime)
    return max(time.time() - max(times), 0.0) if times else 0.0


def overview(found: Sequence[Progress]) -> RenderableType:
    """Returns a table with a line for each run, and the number of runs in each state."""
    parent = os.path.commonpath([progress.folder.parent for progress in found])
    names = [printable(str(progress.folder.relative_to(parent))) for progress in found]
    table = Table(box=None, pad_edge=False)
    table.add_column("run", overflow="fold")
    columns = {"state": 10, "updates": 7, "": WIDTH, "last": 16, "written": 10}
    for name, width in columns.items():
        table.add_column(name, no_wrap=True, min_width=width)
    for name, progress in zip(names, found, strict=True):
        table.add_row(
            Text(name),
            Text(progress.state, style=COLOURS[progress.state]),
            *map(Text, _measured(progress.runs)),
            f"{duration(progress.age)} ago",
        )
    told = [
        Text(f"failed: {name}: {progress.failure}", style="red")
        if progress.failure
        else Text(f"{name}: {progress.activity}")
        for name, progress in zip(names, found, strict=True)
        if progress.failure or progress.activity
    ]
    states = [progress.state for progress in found]
    counts = ", ".join(f"{states.count(state)} {state}" for state in COLOURS if state in states)
    return Group(table, *told, Text(f"{len(found)} runs: {counts}"))


def _measured(runs: Sequence[Run]) -> tuple[str, str, str]:
    """Returns the updates, the headline's curve and its last value as texts: the seeds' mean."""
    if not runs:
        return "–", "", ""
    run = runs[0]
    # Of seeds that are trained together one can have a row more than another.
    known = min(len(each.metrics[run.headline]) for each in runs)
    values = np.mean([each.metrics[run.headline][:known] for each in runs], 0)
    low, high = (0, 1) if is_rate(run.headline) else (float(values.min()), float(values.max()))
    updates = f"{run.updates}/{run.planned}" if run.planned else str(run.updates)
    curve = sparkline(_some(values), low, high)
    return updates, curve, f"{words(run.headline)} {values[-1]:.3f}"


def sparkline(values: Iterable[float], low: float, high: float) -> str:
    """Returns values as blocks of rising height; values outside are drawn at the edge."""
    span = (high - low) or 1.0
    steps = [(value - low) / span * (len(BLOCKS) - 1) for value in values]
    return "".join(BLOCKS[min(max(round(step), 0), len(BLOCKS) - 1)] for step in steps)


def _some(values: Sequence[float] | Column) -> Sequence[float] | Column:
    """Returns the values, or as many of them, evenly spaced, as a curve has characters."""
    if len(values) <= WIDTH:
        return values
    return np.asarray(values)[np.linspace(0, len(values) - 1, WIDTH).round().astype(int)]
