"""What an update of each method takes where all are timed in turns, in place of what runs took."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.records import number, printable
from proposer_rl.report.studies import Group, Study
from proposer_rl.runs.folder import read_bounded

LARGEST_FILE = 2**20
BENCHMARK = "curricula"


class Timing(NamedTuple):
    """Methods timed in turns on one machine.

    Attributes:
        seconds: of an update by the method's label, the curriculum's share included: medians.
        machine: in words; with those that were timed later, beside some of the others.
    """

    seconds: Mapping[str, float]
    machine: str


def read_timing(files: Sequence[Path]) -> Timing:
    """What ``bin/bench curricula --runs`` wrote: of all methods, then of further ones.

    A method that only a later file has takes as much longer than the methods that the files have in
    common as it did when it was timed beside these (the median of the ratios).

    Raises:
        UnreadableRun: if a file holds something else, or methods that were timed beside none of
            those before.
        StorageError: if one cannot be read.
    """
    found = _read(files[0])
    for file in files[1:]:
        other = _read(file)
        common = [name for name in other.seconds if name in found.seconds]
        if not common:
            raise UnreadableRun(
                f"--seconds {file}: has methods that were timed beside none of: "
                f"{', '.join(found.seconds)}"
            )
        scale = float(np.median([found.seconds[name] / other.seconds[name] for name in common]))
        new = {k: scale * value for k, value in other.seconds.items() if k not in found.seconds}
        beside = f"{', '.join(new)} beside {', '.join(common)} on {other.machine}"
        found = Timing({**found.seconds, **new}, f"{found.machine}; {beside}")
    return found


def _read(file: Path) -> Timing:
    try:
        found: Any = json.loads(read_bounded(file, LARGEST_FILE))
        measured, machine = found["benchmarks"][BENCHMARK], found["machine"]
        samples = measured["result"]["rows"][0]["samples"]
        seconds = {str(name): number(float(np.median(times))) for name, times in samples.items()}
        if not seconds or not all(value > 0 for value in seconds.values()):
            raise ValueError("no times")
        device = printable(str(machine.get("gpu", machine["processor"])))
        return Timing(seconds, f"{device}, threads: {int(measured['threads'])}")
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise UnreadableRun(
            f"{file}: holds no seconds of methods as bin/bench {BENCHMARK} --runs writes them"
        ) from error


def timed(study: Study, timing: Timing) -> Study:
    """The study as if every update of a method had taken the seconds timed.

    Raises:
        UnreadableRun: if a method was not timed.
    """
    groups = tuple(_timed(group, timing) for group in study.groups)
    return replace(study, groups=groups, timed=timing.machine)


def _timed(group: Group, timing: Timing) -> Group:
    if group.label not in timing.seconds:
        known = ", ".join(timing.seconds)
        raise UnreadableRun(f"--seconds: has none of {group.label!r}, but of: {known}")
    each = timing.seconds[group.label]
    return replace(
        group,
        runs=tuple(
            replace(
                run,
                metrics={**run.metrics, "seconds": each * run.metrics["updates"]},
                shared_by=1,
            )
            for run in group.runs
        ),
    )
