"""A cycle of the copies in one worker and in two: what each of two still gets done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any, Literal

from benchmarks.results import Options, Result, Row, Spread, Table
from benchmarks.scales import QUICK, TINY, Scale
from benchmarks.timing import interleave, ratio, threads
from proposer_rl.learning.ppo import PPO
from proposer_rl.meta.rewards import performance_gain
from proposer_rl.meta.workers import WorkerSettings
from proposer_rl.methods import Parts, proposer
from proposer_rl.streams import Streams

UPDATES = 5
Engine = Literal["multiprocess", "ray"]


def throughput(options: Options) -> Result:
    """Throughput per worker of two against one, each on one core of this machine."""
    scale = TINY if options.tiny else _shorter(QUICK)
    engines: list[Engine] = ["multiprocess"]
    if not options.tiny and find_spec("ray") is not None:
        engines.append("ray")
    rows, lines = [], []
    copies = f"K = {scale.proposer.rollouts}, {'tiny' if options.tiny else 'quick'} values"
    for engine in engines:
        with threads(1), _cluster(engine), ExitStack() as stack:
            rounds = {
                name: _cycle(scale, options, workers, stack)
                for name, workers in {
                    "one process": None,
                    "one worker": _workers(engine, 1, options),
                    "two workers": _workers(engine, 2, options),
                }.items()
            }
            seconds = interleave(rounds, options.repeats, options.device)
        rows.append(
            Row(
                f"throughput per worker of two {engine} workers, {copies}",
                "of one worker",
                ratio(seconds["one worker"], seconds["two workers"], 0.5),
                "x",
                samples=seconds,
            )
        )
        lines += [[engine, name, f"{Spread.of(s).median:.2f}"] for name, s in seconds.items()]
    title = f"Rollouts of the copies of a cycle, {copies}, one core each"
    return Result(rows, [Table(title, ["engine", "where", "seconds"], lines)])


def _shorter(scale: Scale) -> Scale:
    """The same with episodes of a few updates: an update takes as long in any."""
    return replace(
        scale, proposer=replace(scale.proposer, lookahead=UPDATES, updates_per_step=UPDATES)
    )


def _workers(engine: Engine, count: int, options: Options) -> WorkerSettings:
    return WorkerSettings(engine=engine, workers=count, devices=[options.device], cores=1)


def _cycle(
    scale: Scale, options: Options, workers: WorkerSettings | None, stack: ExitStack
) -> Callable[[], object]:
    """Rolls the copies of a cycle out, always the same ones."""
    task = scale.task(options)
    task.cores = 1
    parts = Parts(task, scale.proposer, seed=0, workers=workers)
    curriculum: Any = proposer(parts, performance_gain)
    stack.enter_context(closing(curriculum))
    solver: PPO = task.solvers([Streams(0, "solver")])
    return partial(curriculum.copies.roll_out, solver.snapshot()[0], Streams(0, "cycle", 0))


@contextmanager
def _cluster(engine: Engine) -> Iterator[None]:
    """A cluster with room for one worker and two others."""
    if engine != "ray":
        yield
        return
    import ray

    ray.init("local", num_cpus=3, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()
