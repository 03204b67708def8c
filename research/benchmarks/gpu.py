"""What a GPU is for: milliseconds of an update and of a meta-environment step, seconds of a run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from research.benchmarks.meta import EVERY_UPDATE, parts_table, step_and_parts, trainer_of
from research.benchmarks.results import Options, Result, Row, Spread
from research.benchmarks.scales import Scale, Solvers, paper, precisions
from research.benchmarks.timing import interleave, synchronise, time_once

NOTHING = "There is no GPU here: none of its targets is measured."


def gpu_targets(options: Options) -> Result:
    """Everything that is promised of a GPU, at the paper's values."""
    if not (options.tiny or options.device.startswith("cuda")):
        return Result([], notes=[NOTHING])
    if options.precision == "auto":
        options = replace(options, precision=precisions(options)[-1])
    scale = paper(options)
    steps = [_meta_step(scale.but(*way), options) for way in _ways(options)]
    rows = [row for step in steps for row in step.rows]
    tables = [table for step in steps for table in step.tables]
    return Result([*_update(scale, options), *rows, *_runs(scale, options)], tables)


def _ways(options: Options) -> list[list[str]]:
    """Without and, on a GPU, with a compiler."""
    return [[], ["compute.compile=true"]] if options.device.startswith("cuda") else [[]]


def _update(scale: Scale, options: Options) -> list[Row]:
    """One Solver in both precisions, without graphs, compiled; and how long the host is busy."""
    ways = {
        options.precision: [],
        "fp32 (TF32)": ["precision=fp32"],
        f"{options.precision}, without graphs": ["compute.graphs=false"],
    }
    ways |= {f"{options.precision}, compiled": way for way in _ways(options)[1:]}
    updates = {name: Solvers(scale.task(options, *way)).update for name, way in ways.items()}
    seconds = interleave(updates, options.repeats, options.device)
    rows = [
        _row(f"a Solver update, {name}", "K = 1", times, 8e-3 if i == 0 else None)
        for i, (name, times) in enumerate(seconds.items())
    ]
    first = next(iter(updates))
    host = [_host_seconds(updates[first], options.device) for _ in range(options.repeats)]
    return [*rows, _row("... of which the host is busy", first, host)]


def _meta_step(scale: Scale, options: Options) -> Result:
    """K Solvers: a step and its parts."""
    env = trainer_of(scale.made(options, EVERY_UPDATE)).env
    seconds = step_and_parts(env, options.repeats, options.device)
    size = f"K = {scale.config.proposer.rollouts}, {options.precision}"
    size += ", compiled" * scale.config.compute.compile
    row = _row("a meta-environment step", size, seconds["step"], 50e-3)
    return Result([row], [parts_table(f"Parts of a meta-environment step, {size}", seconds)])


def _runs(scale: Scale, options: Options) -> list[Row]:
    """A whole run of `target`; of `perf_gain` one cycle, times their number."""
    schedule = scale.config.schedule
    cycles = schedule.updates // schedule.cycle_length
    target = Scale(scale.name, "target")
    plain, made = (each.made(options) for each in (target, scale))
    start = made.learner.snapshot()

    def one_cycle() -> None:
        made.learner.restore(start)
        scale.run(options, made, f"schedule.updates={schedule.cycle_length}")

    one_cycle()  # PyTorch chooses its kernels here, and graphs are recorded
    size = f"{schedule.updates} updates"
    whole = time_once(lambda: target.run(options, plain), options.device)
    several = cycles * time_once(one_cycle, options.device)
    return [
        _row("a complete run, target", size, [whole], 15),
        _row(f"a complete run, perf_gain, {cycles} x one cycle", size, [several], 180),
    ]


def _host_seconds(call: Callable[[], object], device: str) -> float:
    """How long a call keeps the host, beginning with an idle device."""
    synchronise(device)
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _row(what: str, against: str, seconds: list[float], target: float | None = None) -> Row:
    return Row(
        what,
        against,
        Spread.of(seconds),
        "s" if target is not None and target > 1 else "ms",
        target=target,
        at_most=True,
        samples={what: seconds},
    )
