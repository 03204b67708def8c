"""A cycle of the copies in one worker and in two: what each of two still gets done."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from importlib.util import find_spec

from proposer_rl.streams import Streams
from research.benchmarks.meta import trainer_of
from research.benchmarks.results import Options, Result, Row, Spread, Table
from research.benchmarks.scales import QUICK, TINY, Scale
from research.benchmarks.timing import interleave, ratio, threads


def throughput(options: Options) -> Result:
    """Throughput per worker of two against one, each on one core of this machine.

    A worker of two has half of the copies, over which what an update costs whatever their number is
    shared by fewer. What the workers themselves cost is seen against one process with that many.
    """
    scale = TINY.but("proposer.rollouts=4") if options.tiny else QUICK
    engines = ["multiprocess"]
    if not options.tiny and find_spec("ray") is not None:
        engines.append("ray")
    rows, lines = [], []
    number = scale.config.proposer.rollouts
    half = scale.but(f"proposer.rollouts={number // 2}")
    copies = f"K = {number}, {scale.name} values"
    for engine in engines:
        with threads(1), _cluster(engine), ExitStack() as stack:
            rounds = {
                "one process": _cycle(scale, options, stack),
                "one process, half of the copies": _cycle(half, options, stack),
                "one worker": _cycle(scale, options, stack, *_workers(engine, 1)),
                "two workers": _cycle(scale, options, stack, *_workers(engine, 2)),
            }
            seconds = interleave(rounds, options.few, options.device)
        against = {
            "of one worker": ratio(seconds["one worker"], seconds["two workers"], 0.5),
            "of a process with half of the copies": ratio(
                seconds["one process, half of the copies"], seconds["two workers"]
            ),
        }
        rows += [
            Row(
                f"throughput per worker of two {engine} workers, {copies}",
                reference,
                measured,
                "x",
                target=0.95 if engine == "multiprocess" else None,
                samples=seconds,
            )
            for reference, measured in against.items()
        ]
        lines += [[engine, name, f"{Spread.of(s).median:.2f}"] for name, s in seconds.items()]
    title = f"Rollouts of the copies of a cycle, {copies}, one core each"
    return Result(rows, [Table(title, ["engine", "where", "seconds"], lines)])


def _workers(engine: str, count: int) -> list[str]:
    chosen = [f"collector={engine}", f"workers={count}"]
    return [f"compute.{choice}" for choice in chosen]


def _cycle(scale: Scale, options: Options, stack: ExitStack, *workers: str) -> Callable[[], object]:
    """Rolls the replicas of a cycle out, always the same ones."""
    made = scale.made(options, "compute.cores=1", *workers)
    stack.enter_context(closing(made.curricula[0]))
    replicas, solver = trainer_of(made).replicas, made.learner.snapshot()[0]
    return partial(replicas.roll_out, solver, Streams(0, "cycle", 0))


@contextmanager
def _cluster(engine: str) -> Iterator[None]:
    """A cluster with room for one worker and two others."""
    if engine != "ray":
        yield
        return
    import ray

    ray.init("local", num_cpus=3, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()
