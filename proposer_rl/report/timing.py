"""What an update of each method takes where all are timed in turns, in place of what runs took."""

from __future__ import annotations

import json
from collections.abc import Mapping
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
        machine: in words.
    """

    seconds: Mapping[str, float]
    machine: str


def read_timing(file: Path) -> Timing:
    """What ``bin/bench curricula --runs`` wrote.

    Raises:
        UnreadableRun: if the file holds something else.
        StorageError: if it cannot be read.
    """
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
