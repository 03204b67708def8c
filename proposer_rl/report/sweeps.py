"""How long the rest of a sweep will take, from what its finished runs took."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from proposer_rl.report.reading import FAILURE, begun
from proposer_rl.report.records import number, small_json
from proposer_rl.runs.folder import read_bounded
from proposer_rl.runs.status import FILE, duration

PLAN = "multirun.yaml"  # Hydra's, in a sweep's folder
SUMMARY = "summary.json"
GOING = 600.0  # seconds since a run that goes on has said so
SEEDS = ("seed=", "seeds=")  # two runs that differ in nothing else take as long
# What does not say what a run is; `precision=auto` goes on in whichever a run was begun in.
ASIDE = ("+sweep=", "compute.", "logger", "hydra.", "precision=")
LARGEST_PLAN = 2**20  # bytes


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


def left(folder: Path, planned: Sequence[Collection[str]]) -> Left | None:
    """What is left of the sweep in a folder; None where nothing is known of a plan.

    A run is finished where one has ended that was given the plan's settings for it and no others,
    by this sweep or by a command of its own: an ablation is not the run without it. What does not
    say what a run is (``ASIDE``) counts only where it is swept, and what the plan computes, as
    ``${scale}``, not at all.

    A run takes as long as the mean of the finished ones that differ from it in the seed alone, or
    else of all; of one that goes on that is the whole.

    Args:
        folder: of the sweep, with its plan.
        planned: of each run the settings in which it differs from others.

    Raises:
        UnreadableRun: if there is no such folder.
    """
    plan = _plan(folder) if planned else None
    if plan is None:
        return None
    asked, aside = _asked(planned, plan)
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
    rest = [own for own in asked if own not in finished]
    at_once = max(going, 1)
    seconds = None
    if every:
        known = (spent.get(_but_for_the_seed(own), every) for own in rest)
        seconds = sum(float(np.mean(alike)) for alike in known) / at_once
    return Left(len(rest), len(planned), seconds, at_once)


def _asked(
    planned: Sequence[Collection[str]], plan: Mapping[str, str]
) -> tuple[list[frozenset[str]], tuple[str, ...]]:
    """What counts of the settings of each planned run, and how those begin that do not count."""
    swept = {word.partition("=")[0] for word in planned[0]}
    shared = {key: value for key, value in plan.items() if key not in swept}
    aside = [start for start in ASIDE if not any(f"{key}=".startswith(start) for key in swept)]
    # Hydra's `range(3,4)` and `${scale}`: what becomes of them is not in the plan.
    aside += [f"{key}=" for key, value in shared.items() if "(" in value or "$" in value]
    words = [f"{key}={value}" for key, value in shared.items()]
    return [_settings([*own, *words], tuple(aside)) for own in planned], tuple(aside)


def _plan(folder: Path) -> dict[str, str] | None:
    """What the runs of a sweep are given, by key and as it was written: what is swept, too.

    Returns:
        None where the plan cannot be understood, such as while it is written.
    """
    try:
        hydra = yaml.safe_load(read_bounded(folder / PLAN, LARGEST_PLAN))["hydra"]
        given = (str(word).partition("=") for word in hydra["overrides"]["task"])
        # What stands on the command line replaces what the sweep's file says.
        found = {**(hydra["sweeper"]["params"] or {}), **{key: value for key, _, value in given}}
    except (OSError, ValueError, LookupError, TypeError, RecursionError, yaml.YAMLError):
        return None
    return {str(key): str(value) for key, value in found.items()}


def _settings(words: object, aside: tuple[str, ...]) -> frozenset[str]:
    """What of a command's words counts, spelt alike: Hydra makes 0.001 of 1e-3, True of true."""
    found = set()
    for word in words if isinstance(words, list) else ():
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
