"""Seconds of an update where all methods are timed in turns, in place of what their runs took."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.studies import Group, Study
from proposer_rl.runs.records import number

BENCHMARK = "curricula"

Seconds = Mapping[str, float]  # of an update, by the method's label


class Timing(NamedTuple):
    """Methods timed in turns on one machine.

    Attributes:
        seconds: of an update, the curriculum's share included: medians of the rounds.
        rounds: the same in each round, in which every method had its turn.
        machine: in words; with those that were timed later, beside some of the others.
    """

    seconds: Seconds
    rounds: Sequence[Seconds]
    machine: str


def read_timing(files: Sequence[Path]) -> Timing:
    """What ``bin/bench curricula --runs`` wrote: of all methods, then of further ones.

    A method that only a later file has takes as much longer than the methods that the files have in
    common as it did when it was timed beside these (the median of the ratios). So it is for the
    medians and for each round; where a file has fewer rounds than another they are taken again.

    Raises:
        UnreadableRun: if a file holds something else, or methods that were timed beside none of
            those before.
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
        new = [name for name in other.seconds if name not in found.seconds]
        beside = f"{', '.join(new)} beside {', '.join(common)} on {other.machine}"
        rounds = [
            _joined(found.rounds[i % len(found.rounds)], other.rounds[i % len(other.rounds)])
            for i in range(max(len(found.rounds), len(other.rounds)))
        ]
        seconds = _joined(found.seconds, other.seconds)
        found = Timing(seconds, rounds, f"{found.machine}; {beside}")
    return found


def _joined(found: Seconds, other: Seconds) -> Seconds:
    """With the methods that only the other has, at the pace of the first."""
    scale = float(np.median([found[name] / other[name] for name in other if name in found]))
    return {**found, **{k: scale * value for k, value in other.items() if k not in found}}


def _read(file: Path) -> Timing:
    try:
        found: Any = json.loads(file.read_text(encoding="utf-8-sig"))
        measured, machine = found["benchmarks"][BENCHMARK], found["machine"]
        samples = measured["result"]["rows"][0]["samples"]
        rounds = [
            dict(zip(samples, map(number, times), strict=True))
            for times in zip(*samples.values(), strict=True)
        ]
        if not rounds or not all(value > 0 for each in rounds for value in each.values()):
            raise ValueError("no times")
        seconds = {name: float(np.median([each[name] for each in rounds])) for name in samples}
        device = machine.get("gpu", machine["processor"])
        return Timing(seconds, rounds, f"{device}, threads: {int(measured['threads'])}")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise UnreadableRun(
            f"{file}: holds no seconds of methods as bin/bench {BENCHMARK} --runs writes them"
        ) from error


def timed(study: Study, timing: Timing) -> list[Study]:
    """The study as if every update of a method had taken the seconds timed.

    Returns:
        It by the medians, and then by each round.

    Raises:
        UnreadableRun: if a method was not timed.
    """
    return [
        replace(
            study,
            groups=tuple(_timed(group, seconds) for group in study.groups),
            timed=timing.machine,
        )
        for seconds in (timing.seconds, *timing.rounds)
    ]


def _timed(group: Group, seconds: Seconds) -> Group:
    if group.label not in seconds:
        known = ", ".join(seconds)
        raise UnreadableRun(f"--seconds: has none of {group.label!r}, but of: {known}")
    each = seconds[group.label]
    return replace(
        group,
        runs=tuple(
            replace(
                run,
                metrics=run.metrics.assign(seconds=each * run.metrics["updates"]),
                shared_by=1,
            )
            for run in group.runs
        ),
    )
