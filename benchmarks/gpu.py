"""What a GPU is for: milliseconds of an update and of a meta-environment step, seconds of a run."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.meta import MetaStep, StepParts, proposer_curriculum
from benchmarks.results import Options, Result, Row, Spread
from benchmarks.scales import PAPER, TINY, Scale, Solvers, bf16_in_hardware
from benchmarks.timing import interleave, synchronise, time_once
from proposer_rl.curricula import Curriculum, SamplingCurriculum
from proposer_rl.experiment import Experiment, Schedule
from proposer_rl.mazes.task import MazeTask
from proposer_rl.runs.folder import RunFolder
from proposer_rl.streams import Streams

NOTHING = "There is no GPU here: none of its targets is measured."


def gpu_targets(options: Options) -> Result:
    """Everything that is promised of a GPU, at the paper's values."""
    if not (options.tiny or options.device.startswith("cuda")):
        return Result([], notes=[NOTHING])
    scale = TINY if options.tiny else PAPER
    precision = "bf16" if bf16_in_hardware(options.device) else "fp32"
    results = [
        _update(scale, options, precision),
        _meta_step(scale, options, precision),
        _runs(scale, options, precision),
    ]
    return Result(
        [row for result in results for row in result.rows],
        [table for result in results for table in result.tables],
    )


def _update(scale: Scale, options: Options, precision: str) -> Result:
    """One Solver: replayed in both precisions, and as it is; and how long the host is busy."""
    solvers = {
        f"{precision}, replayed": Solvers(scale.task(options, precision)),
        "fp32 (TF32), replayed": Solvers(scale.task(options, "fp32")),
        f"{precision}, not replayed": Solvers(scale.task(options, precision, graphs=False)),
    }
    candidates: dict[str, Callable[[], object]] = {n: s.update for n, s in solvers.items()}
    seconds = interleave(candidates, options.repeats, options.device)
    rows = [
        _row(f"a Solver update, {name}", "K = 1", times, 8e-3 if i == 0 else None, options)
        for i, (name, times) in enumerate(seconds.items())
    ]
    first = next(iter(solvers.values()))
    host = [_host_seconds(first.update, options.device) for _ in range(options.repeats)]
    rows.append(
        _row("... of which the host is busy", f"{precision}, replayed", host, None, options)
    )
    return Result(rows)


def _meta_step(scale: Scale, options: Options, precision: str) -> Result:
    """K Solvers: a step and its parts."""
    task = scale.task(options, precision)
    env = proposer_curriculum(task, scale).env
    parts = StepParts(task, env)
    steps: dict[str, Callable[[], object]] = {"step": MetaStep(env), "parts": parts}
    seconds = interleave(steps, options.repeats, options.device)
    size = f"K = {scale.proposer.rollouts}, {precision}"
    row = _row("a meta-environment step", size, seconds["step"], 50e-3, options)
    return Result([row], [parts.table(f"Parts of a meta-environment step, {size}")])


def _runs(scale: Scale, options: Options, precision: str) -> Result:
    """A whole run of `target`; of `perf_gain` one cycle, times their number."""
    updates, cycle = (6, scale.proposer.lookahead) if options.tiny else (750, 50)
    cycles = updates // cycle
    task = scale.task(options, precision)
    target = _run_seconds(task, SamplingCurriculum(task.sample_target), updates, cycle, options)
    curriculum = proposer_curriculum(task, scale)
    _run_seconds(task, curriculum, cycle, cycle, options)  # everything is recorded here
    one = _run_seconds(task, curriculum, cycle, cycle, options)
    return Result(
        [
            _row("a complete run, target", f"{updates} updates", [target], 15, options),
            _row(
                f"a complete run, perf_gain, {cycles} x one cycle",
                f"{updates} updates",
                [cycles * one],
                180,
                options,
            ),
        ]
    )


def _run_seconds(
    task: MazeTask, curriculum: Curriculum, updates: int, cycle: int, options: Options
) -> float:
    """An experiment from beginning to end, with its evaluations and checkpoints."""
    with tempfile.TemporaryDirectory() as folder:
        experiment = Experiment(
            task.solvers([Streams(0, "solver")]),
            curriculum,
            schedule=Schedule(updates=updates, cycle_length=cycle),
            seeds=[0],
            folder=RunFolder(Path(folder)),
            evaluate=task.measure,
            statistics=task.statistics,
            records=task.records,
            progress=False,
        )
        return time_once(experiment.run, options.device)


def _host_seconds(call: Callable[[], object], device: str) -> float:
    """How long a call keeps the host, beginning with an idle device."""
    synchronise(device)
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _row(
    what: str, against: str, seconds: list[float], target: float | None, options: Options
) -> Row:
    return Row(
        what,
        against,
        Spread.of(seconds),
        "s" if target is not None and target > 1 else "ms",
        target=None if options.tiny else target,
        at_most=True,
        samples={what: seconds},
    )
