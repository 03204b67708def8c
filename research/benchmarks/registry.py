"""The benchmarks by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from research.benchmarks.ceiling import against_convolutions
from research.benchmarks.curricula import update_seconds
from research.benchmarks.environment import environment_steps
from research.benchmarks.evaluation import exact_evaluation
from research.benchmarks.gpu import gpu_targets
from research.benchmarks.gymnasium import against_sb3
from research.benchmarks.learning import learning_curves
from research.benchmarks.levels import generation, shortest_paths
from research.benchmarks.meta import memory, meta_step
from research.benchmarks.placement import throughput
from research.benchmarks.processes import in_processes
from research.benchmarks.results import Options, Result
from research.benchmarks.robots import robots
from research.benchmarks.solver import against_plain, in_both_precisions, overhead, population
from research.benchmarks.teacher import teacher_calls
from research.benchmarks.view import view_steps
from research.benchmarks.view_training import view_training


class Benchmark(NamedTuple):
    """A benchmark: what it is about, what runs it, and when it runs without being named.

    Attributes:
        about: one line for a list.
        run: the measurement.
        on: ``"default"``, ``"full"`` (only with the full sizes), ``"cuda"`` (only on a GPU) or
            ``"request"``.
    """

    about: str
    run: Callable[[Options], Result]
    on: str = "default"


BENCHMARKS = {
    "levels": Benchmark("levels generated per second", generation),
    "shortest_paths": Benchmark("shortest paths against networkx and scipy", shortest_paths),
    "environment": Benchmark("environment steps against Gymnasium", environment_steps),
    "processes": Benchmark("environments of Gymnasium in several processes", in_processes),
    "view": Benchmark("steps in the view maze against MiniGrid", view_steps),
    "view_training": Benchmark("training in the view maze, beside jaxued's PPO", view_training),
    "evaluation": Benchmark("exact evaluation against a Solver update", exact_evaluation),
    "overhead": Benchmark("what of a Solver update is not the network", overhead),
    "precision": Benchmark("a Solver update in bf16 against fp32", in_both_precisions),
    "ceiling": Benchmark(
        "a Solver update against its convolutions alone, and a profile", against_convolutions
    ),
    "meta": Benchmark("a meta-environment step against its parts", meta_step),
    "population": Benchmark("K Solvers in one update against one after another", population),
    "update": Benchmark("a Solver update against the plain TorchRL way", against_plain),
    "curricula": Benchmark("seconds of an update by curriculum", update_seconds),
    "teacher": Benchmark("an ask and a tell in a loop of one's own", teacher_calls),
    "robots": Benchmark("the teacher's share of what thousands of robots cost", robots),
    "workers": Benchmark("rollouts of the copies in one worker and in two", throughput),
    "gpu": Benchmark("milliseconds and seconds on a GPU, a minute or two", gpu_targets, "cuda"),
    "memory": Benchmark("peak memory at the paper's values (a minute)", memory, "full"),
    "learning": Benchmark("learning curves in bf16 and fp32 (minutes)", learning_curves, "request"),
    "gymnasium": Benchmark("PPO against Stable-Baselines3's (an hour)", against_sb3, "request"),
}


def measure(name: str, options: Options) -> Result:
    """Run a benchmark; at a tiny size nothing is claimed."""
    result = BENCHMARKS[name].run(options)
    if options.tiny:
        result.rows = [replace(row, target=None) for row in result.rows]
    return result


def selected(names: list[str], full: bool, cuda: bool = False) -> list[str]:
    """The names given, or without any those that run by default."""
    allowed = {"default"} | ({"full"} if full else set()) | ({"cuda"} if cuda else set())
    return names or [name for name, benchmark in BENCHMARKS.items() if benchmark.on in allowed]
