"""How far runs and sweeps are, read from their folders without disturbing them."""

from __future__ import annotations

import math
import os
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import BaseModel, Field

from proposer_rl.report.reading import FAILURE, UnreadableRun, begun, read_run
from proposer_rl.report.records import (
    LARGEST,
    LONGEST_TEXT,
    Text,
    checked,
    number,
    printable,
    small_json,
)
from proposer_rl.report.runs import Run
from proposer_rl.runs.status import FILE, Activity, duration

PLAN = "multirun.yaml"  # Hydra's, in a sweep's folder
SUMMARY = "summary.json"
GOING = 600.0  # seconds since a run that goes on has said so
STOPPED = 128  # a greater exit code is that of a signal: the run can go on
SEEDS = ("seed=", "seeds=")  # two runs that differ in nothing else take as long
# What does not say what a run is; `precision=auto` goes on in whichever a run was begun in.
ASIDE = ("+sweep=", "compute.", "logger", "hydra.", "precision=")


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
    """The states of all runs in a folder, or of the folder itself."""
    found = [read_progress(path) for path, _ in begun(folder)]
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


class _Recorded(BaseModel):
    doing: Text
    done: int
    of: int
    seconds_left: Annotated[float, Field(ge=0, lt=LARGEST, allow_inf_nan=False)] | None
    at_least: bool


def recorded_activity(folder: Path) -> Activity | None:
    """The status file of a run; None where the run is over or the file cannot be read."""
    try:
        found = checked(_Recorded, small_json(folder / FILE, 2**12), FILE)
    except ValueError:
        return None
    return Activity(**found.model_dump())


def _age(folder: Path) -> float:
    times = [entry.stat().st_mtime for entry in os.scandir(folder) if entry.is_file()]
    return max(time.time() - max(times), 0.0) if times else 0.0


class Left(NamedTuple):
    """What is left of a sweep.

    Attributes:
        runs: that are not finished.
        of: so many.
        seconds: that they will take; None where nothing has finished yet.
        at_once: runs that go on side by side.
    """

    runs: int
    of: int
    seconds: float | None
    at_once: int

    def text(self) -> str:
        """As in ``sweep: 30 of 50 runs left, about 5 h, 2 at a time``."""
        said = f"sweep: {self.runs} of {self.of} runs left"
        if not self.runs or self.seconds is None:
            return said
        return f"{said}, about {duration(self.seconds)}, {self.at_once} at a time"


def left(folder: Path, planned: Sequence[Sequence[str]]) -> Left | None:
    """What is left of the sweep in a folder; None where nothing is known of a plan.

    A run is finished where one has ended that was given the plan's settings for it and no others,
    by this sweep or by a command of its own: an ablation is not the run without it. What does not
    say what a run is (``ASIDE``) counts only where it is swept, and what the plan computes, as
    ``${scale}``, not at all.

    A run takes as long as the mean of the finished ones that differ from it in the seed alone, or
    else of all; of one that goes on that is the whole.
    """
    if not planned:
        return None
    alike = frozenset.intersection(*map(frozenset, planned))
    swept = {word.partition("=")[0] for own in planned for word in own if word not in alike}
    aside = (
        *(start for start in ASIDE if not any(f"{key}=".startswith(start) for key in swept)),
        *(f"{word.partition('=')[0]}=" for word in alike if "$" in word),
    )
    finished: set[frozenset[str]] = set()
    spent: defaultdict[frozenset[str], list[float]] = defaultdict(list)
    going = 0
    for path, files in begun(folder):
        if SUMMARY in files:
            said = _mapping(path / SUMMARY)
            settings = _settings(said.get("overrides"), aside)
            finished.add(settings)
            if math.isfinite(took := number(said.get("seconds"))):
                spent[_but_for_the_seed(settings)].append(took)
        elif FAILURE not in files and FILE in files:
            going += time.time() - (path / FILE).stat().st_mtime < GOING
    every = [took for alike in spent.values() for took in alike]
    asked = [_settings(own, aside) for own in planned]
    rest = [own for own in asked if own not in finished]
    at_once = max(going, 1)
    seconds = None
    if every:
        known = (spent.get(_but_for_the_seed(own), every) for own in rest)
        seconds = sum(float(np.mean(took)) for took in known) / at_once
    return Left(len(rest), len(planned), seconds, at_once)


def _settings(words: object, aside: tuple[str, ...]) -> frozenset[str]:
    """What of a command's words counts, spelt alike: Hydra makes 0.001 of 1e-3, True of true."""
    found = set()
    for word in words if isinstance(words, list | tuple) else ():
        if isinstance(word, str) and not word.startswith(aside):
            key, _, value = "".join(word.split()).partition("=")
            with suppress(ValueError):
                value = str(float(value))
            found.add(f"{key}={value.lower()}")
    return frozenset(found)


def _but_for_the_seed(settings: Iterable[str]) -> frozenset[str]:
    return frozenset(word for word in settings if not word.startswith(SEEDS))


def _mapping(path: Path) -> dict[str, object]:
    found = small_json(path)
    return found if isinstance(found, dict) else {}
