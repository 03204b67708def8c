"""How long the rest of a sweep will take, from what its finished runs took."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from proposer_rl.report.progress import recorded_activity
from proposer_rl.report.reading import FAILURE, begun
from proposer_rl.report.records import number, small_json
from proposer_rl.runs.status import FILE, duration

PLAN = "multirun.yaml"  # Hydra's, in a sweep's folder
SUMMARY = "summary.json"
GOING = 600.0  # seconds since a run that goes on has said so
SEEDS = ("seed=", "seeds=")  # two runs that differ in nothing else take as long


class Left(NamedTuple):
    """What is left of a sweep.

    Attributes:
        runs: that are not finished.
        of: so many.
        seconds: that they will take; None where nothing has finished yet.
        at_once: runs that go on side by side.
        unlike: of how many of these nothing has finished that differs in the seed alone.
    """

    runs: int
    of: int
    seconds: float | None
    at_once: int
    unlike: int

    def text(self) -> str:
        """As in ``sweep: 30 of 50 runs left, about 5 h, 2 at a time``."""
        said = f"sweep: {self.runs} of {self.of} runs left"
        if not self.runs or self.seconds is None:
            return said
        said += f", about {duration(self.seconds)}, {self.at_once} at a time"
        guessed = f"; of {self.unlike} no other seed has finished: they count as the others' mean"
        return said + guessed * (self.unlike > 0)


def left(folder: Path, planned: Sequence[Collection[str]]) -> Left | None:
    """What is left of the sweep in a folder; None where nothing is known of a plan.

    A run takes as long as the mean of the finished ones that differ from it in the seed alone, or
    else of all; one that goes on what it says itself.

    Args:
        folder: of the sweep.
        planned: of each run the settings in which it differs from others.

    Raises:
        UnreadableRun: if there is no such folder.
    """
    if not planned:
        return None
    finished: list[tuple[set[str], float]] = []
    going: list[tuple[set[str], float]] = []
    for path, files in begun(folder):
        if SUMMARY in files:
            said = _told(path / SUMMARY)
            finished.append((_settings(said), number(said.get("seconds"))))
        elif FAILURE in files:
            continue
        elif FILE in files and time.time() - (path / FILE).stat().st_mtime < GOING:
            activity = recorded_activity(path)
            seconds = activity.seconds_left if activity else None
            rest = math.nan if seconds is None else seconds
            going.append((_settings(_told(path / "run.json")), rest))
    spent = [(settings, seconds) for settings, seconds in finished if math.isfinite(seconds)]
    runs, unlike, total = 0, 0, 0.0
    for own in map(set, planned):
        if any(own <= settings for settings, _ in finished):
            continue
        runs += 1
        told = [rest for settings, rest in going if own <= settings and math.isfinite(rest)]
        kind = {word for word in own if not word.startswith(SEEDS)}
        like = [seconds for settings, seconds in spent if kind <= settings]
        unlike += not told and not like
        known = told[:1] or like or [seconds for _, seconds in spent]
        total += float(np.mean(known)) if known else math.nan
    at_once = max(len(going), 1)
    seconds = None if math.isnan(total) else total / at_once
    return Left(runs, len(planned), seconds, at_once, unlike)


def _settings(said: dict[str, object]) -> set[str]:
    found = said.get("overrides")
    return {word for word in found if isinstance(word, str)} if isinstance(found, list) else set()


def _told(path: Path) -> dict[str, object]:
    found = small_json(path)
    return found if isinstance(found, dict) else {}
