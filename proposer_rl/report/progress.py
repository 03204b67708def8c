"""How far runs are, read from their folders without disturbing them."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, Field

from proposer_rl.report.reading import FAILURE, UnreadableRun, begun, read_run
from proposer_rl.report.records import LARGEST, LONGEST_TEXT, Text, checked, printable, small_json
from proposer_rl.report.runs import Run
from proposer_rl.runs.status import FILE, Activity


@dataclass(frozen=True)
class Progress:
    """The state of one run's folder.

    Attributes:
        folder: of the run.
        runs: its seeds; empty if it has not measured anything yet, or failed before.
        failure: why it failed, in one line; empty if it did not.
        age: seconds since something was written.
        activity: what it was doing then, and how long the rest takes; empty if it does not say.
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
    activity = recorded_activity(folder)
    return Progress(folder, runs, failure, _age(folder), activity.text() if activity else "")


def find_progress(folder: Path) -> list[Progress]:
    """The states of all runs in a folder, or of the folder itself.

    Raises:
        UnreadableRun: if there is no such folder, or no run in it.
    """
    found = [read_progress(path) for path, _ in begun(folder)]
    if not found:
        raise UnreadableRun(f"{folder}: no run in it, finished or begun")
    return found


def _failure(folder: Path) -> str:
    if not (folder / FAILURE).is_file():
        return ""
    match small_json(folder / FAILURE):
        case {"message": message}:
            return printable(str(message))[:LONGEST_TEXT]
    return f"{FAILURE} cannot be read"


class _Recorded(BaseModel):
    doing: Text
    done: int
    of: int
    seconds_left: Annotated[float, Field(ge=0, lt=LARGEST, allow_inf_nan=False)] | None
    at_least: bool


def recorded_activity(folder: Path) -> Activity | None:
    """What a run tells of itself; None where it is over, or that cannot be read."""
    try:
        found = checked(_Recorded, small_json(folder / FILE, 2**12), FILE)
    except ValueError:
        return None
    return Activity(**found.model_dump())


def _age(folder: Path) -> float:
    times = [entry.stat().st_mtime for entry in os.scandir(folder) if entry.is_file()]
    return max(time.time() - max(times), 0.0) if times else 0.0
