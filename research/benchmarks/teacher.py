"""What a teacher costs in somebody's loop: an ask and a tell, one by one and in thousands."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import torch

from proposer_rl import curricula
from proposer_rl.teaching import Items, Parameters, Teacher
from research.benchmarks.memory import peak_memory
from research.benchmarks.peer import said_by
from research.benchmarks.results import Options, Result, Row, Spread
from research.benchmarks.syllabus_peer import __file__ as SYLLABUS
from research.benchmarks.timing import interleave, threads

SLOTS, MANY = 4000, 4096
TARGETS = {"one by one": 20.0, f"{MANY} at once": 2.0}  # microseconds of a level
RANGES, BATCH = (2, 4, 8, 12), 384
ITEMS, FEATURES = 100_000, 16
OF_A_PROPOSAL, OF_A_PAIR, OF_AN_ITEM = 0.030, 60e-6, 5e-6  # targets, seconds
OF_MEMORY, STEPS = 200e6 / 2**30, 120  # target, GiB, after so many steps


def teacher_calls(options: Options) -> Result:
    """Pairs of ask and tell with a full buffer; beside them, drawing levels from the space."""
    count = 64 if options.tiny else MANY
    space = Parameters({"gravity": (5.0, 25.0), "walls": range(60)}, bins=8)
    ways: dict[str, Callable[[], None]] = {}
    for name, way in (("one by one", _one_by_one), (f"{MANY} at once", _at_once)):
        recipe = curricula.plr(capacity=count if options.tiny else SLOTS)
        teacher = Teacher(recipe, space, block=BATCH)
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
    rows += adaptive_mixture(options) + memory(options)
    if options.syllabus is not None:
        rows += beside_syllabus(options.syllabus, 16 if options.tiny else 256, options.repeats)
    return Result(rows)


def adaptive_mixture(options: Options) -> list[Row]:
    """A proposal with more and more parameters, single levels, and many items with features."""
    items = 500 if options.tiny else ITEMS
    count = 64 if options.tiny else MANY
    ways: dict[str, Callable[[], None]] = {}
    per, targets = {}, {}
    for size in RANGES[:1] if options.tiny else RANGES:
        space = ranges(size)
        name = f"a proposal of {BATCH} levels with {size} ranges"
        ways[name] = partial(_batch, Teacher(curricula.adaptive_mixture(), space), BATCH)
        per[name], targets[name] = 1, OF_A_PROPOSAL
        name = f"ask and tell with {size} ranges, one by one, each"
        teacher = Teacher(curricula.adaptive_mixture(), space, block=BATCH)
        ways[name] = partial(_one_by_one, teacher, count)
        per[name], targets[name] = count, OF_A_PAIR
    prompts = prompts_of(items)
    name = f"a step of {count} of {items:,} items with {FEATURES} features"
    ways[name] = partial(_batch, Teacher(curricula.adaptive_mixture(), prompts), count)
    per[name], targets[name] = 1, OF_AN_ITEM * items
    for way in ways.values():
        way()
    with threads(1):
        seconds = interleave(ways, options.repeats)
    return [
        Row(
            f"adaptive mixture, {name}",
            "a number by itself",
            Spread.of([each / per[name] for each in seconds[name]]),
            "ms",
            target=targets[name],
            at_most=True,
            samples={name: seconds[name]},
        )
        for name in ways
    ]


def memory(options: Options) -> list[Row]:
    """Memory of a teacher and its space, each in a process of its own."""
    items, steps = (500, 2) if options.tiny else (ITEMS, STEPS)
    size = RANGES[-1]
    kinds: dict[str, tuple[Callable[[int], Items | Parameters], int, int]] = {
        f"{size} ranges": (ranges, size, BATCH),
        f"{items:,} items with {FEATURES} features": (prompts_of, items, MANY),
    }
    rows = []
    for name, given in kinds.items():
        with ProcessPoolExecutor(1, get_context("spawn")) as alone:
            grown = alone.submit(grown_memory, *given, steps).result()
        rows.append(
            Row(
                f"adaptive mixture, memory after {steps} steps with {name}",
                "beyond what importing takes",
                Spread.of([grown / 2**30]),
                "GiB",
                target=OF_MEMORY,
                at_most=True,
            )
        )
    return rows


def grown_memory(
    make: Callable[[int], Items | Parameters], size: int, count: int, steps: int
) -> int:
    """Bytes by which the peak of this process grows while a teacher is made and teaches."""
    before = peak_memory()
    with threads(1):
        teacher = Teacher(curricula.adaptive_mixture(), make(size))
        for _ in range(steps):
            _batch(teacher, count)
    return peak_memory() - before


def ranges(size: int) -> Parameters:
    """So many ranges, of which one has a target."""
    names = [f"x{i}" for i in range(size)]
    return Parameters(dict.fromkeys(names, (0.0, 1.0)), target={"x0": (0.8, 1.0)}, bins=1)


def prompts_of(items: int) -> Items:
    """So many items with random features."""
    known = torch.rand(items, FEATURES, generator=torch.Generator().manual_seed(0))
    return Items(items, features=known, target=range(items // 100))


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


def _batch(teacher: Teacher, count: int) -> None:
    teacher.propose(count)
    returns = torch.rand(count)
    teacher.observe({"return": returns, "success": returns > 0.5})


def _at_once(teacher: Teacher, count: int) -> None:
    ids, _ = teacher.ask(count)
    returns = torch.rand(count)
    teacher.tell(ids, returns, returns > 0.5)
