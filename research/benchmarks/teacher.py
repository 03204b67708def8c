"""What a teacher costs in somebody's loop: an ask and a tell, one by one and in thousands."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch

from proposer_rl import curricula
from proposer_rl.teaching import Parameters, Teacher
from research.benchmarks.peer import said_by
from research.benchmarks.results import Options, Result, Row, Spread
from research.benchmarks.syllabus_peer import __file__ as SYLLABUS
from research.benchmarks.timing import interleave, threads

SLOTS, MANY = 4000, 4096
TARGETS = {"one by one": 20.0, f"{MANY} at once": 2.0}  # microseconds of a level


def teacher_calls(options: Options) -> Result:
    """Pairs of ask and tell with a full buffer; beside them, drawing levels from the space."""
    count = 64 if options.tiny else MANY
    space = Parameters({"gravity": (5.0, 25.0), "walls": range(60)}, bins=8)
    ways: dict[str, Callable[[], None]] = {}
    for name, way in (("one by one", _one_by_one), (f"{MANY} at once", _at_once)):
        teacher = Teacher(curricula.plr(capacity=count if options.tiny else SLOTS), space)
        _at_once(teacher, count)
        _at_once(teacher, count)
        ways[name] = partial(way, teacher, count)
    ways["levels alone"] = partial(space.sample, count, torch.Generator())
    with threads(1):
        seconds = interleave(ways, options.repeats)
    rows = [
        Row(
            f"ask and tell, PLR with {SLOTS} slots, {name}, each",
            "a number by itself",
            Spread.of([each / count for each in seconds[name]]),
            "ms",
            target=TARGETS[name] / 1e6,
            at_most=True,
            samples=seconds,
        )
        for name in TARGETS
    ]
    if options.syllabus is not None:
        rows += beside_syllabus(options.syllabus, 16 if options.tiny else 256, options.repeats)
    return Result(rows)


def beside_syllabus(python: str, count: int, repeats: int) -> list[Row]:
    """What an episode costs curricula of Syllabus with as many tasks, in its own interpreter."""
    said = said_by(python, SYLLABUS, SLOTS, count, repeats)
    return [
        Row(
            f"Syllabus {said['syllabus']}, {SLOTS} tasks, {name}, each",
            "a sample and an update",
            Spread.of(seconds),
            "ms",
            samples={name: seconds},
        )
        for name, seconds in said["seconds"].items()
    ]


def _one_by_one(teacher: Teacher, count: int) -> None:
    for i in range(count):
        ticket, _ = teacher.ask()
        teacher.tell(ticket, i % 7, i % 2)


def _at_once(teacher: Teacher, count: int) -> None:
    ids, _ = teacher.ask(count)
    returns = torch.rand(count)
    teacher.tell(ids, returns, returns > 0.5)
