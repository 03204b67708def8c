"""One meta-environment step against its parts, and the memory of a run."""

from __future__ import annotations

import resource
import sys
from dataclasses import replace
from typing import Any

import torch

from benchmarks.results import Options, Result, Row, Spread, Table
from benchmarks.scales import PAPER, QUICK, TINY, Scale
from benchmarks.timing import interleave, ratio, threads
from proposer_rl.curricula import ProposerCurriculum
from proposer_rl.learning.ppo import PPO
from proposer_rl.mazes.task import MazeTask
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.rewards import performance_gain
from proposer_rl.methods import Parts, proposer
from proposer_rl.streams import Streams

PARTS = ("generation", "update", "evaluation", "probing")


def meta_step(options: Options) -> Result:
    """A step through TorchRL's interface against what it is made of, called by hand."""
    if options.tiny:
        scales = {"tiny": TINY}
    else:
        scales = {"quick": QUICK.with_copies(16)}
        if options.size == "full":
            scales["paper"] = PAPER
    rows, tables = [], []
    for name, scale in scales.items():
        task = scale.task(options)
        env = proposer_curriculum(task, _acting_at_every_update(scale)).env
        parts = StepParts(task, env)
        with threads(scale.threads):
            seconds = interleave(
                {"step": MetaStep(env), "parts": parts},
                options.few if scale is PAPER else options.repeats,
                options.device,
            )
        size = f"K = {scale.proposer.rollouts}, {name} values, {scale.precision(options)}"
        rows.append(
            Row(
                f"a meta-environment step, {size}",
                "the sum of its parts",
                ratio(seconds["step"], seconds["parts"]),
                "x",
                target=None if options.tiny else 1.05,
                at_most=True,
                samples=seconds,
            )
        )
        tables.append(parts.table(f"Parts of a meta-environment step, {size}"))
    return Result(rows, tables)


class MetaStep:
    """A step with random actions, as a collector makes it."""

    def __init__(self, env: SolverTrainingEnv) -> None:
        self.env = env
        self.state = env.reset()

    @torch.no_grad()
    def __call__(self) -> None:
        """Step every Solver once."""
        action = self.env.action_spec.rand()
        _, self.state = self.env.step_and_maybe_reset(self.state.set("action", action))


class StepParts:
    """What a step consists of, without the environment around it."""

    def __init__(self, task: MazeTask, env: SolverTrainingEnv) -> None:
        self.task = task
        self.solvers = env.solvers
        self.validation, self.probes = env.view.validation, env.view.probes
        self.env = env
        self.streams = [Streams(copy, "bench") for copy in range(env.batch_size[0])]
        self.generators = [stream.generator(device=task.device) for stream in self.streams]
        self.seconds: dict[str, list[float]] = {part: [] for part in PARTS}

    def __call__(self) -> None:
        """All parts, each timed."""
        for part in PARTS:
            timings = interleave({part: getattr(self, part)}, 1, str(self.task.device), warmup=0)
            self.seconds[part] += timings[part]

    def generation(self) -> None:
        """Levels for random actions."""
        action, problems = self.env.action_spec.rand(), self.task.solver.problems
        self.levels, _ = self.env.proposals.levels(action, problems, self.streams)

    def update(self) -> None:
        """One PPO update of each Solver on them."""
        self.solvers.env.set_levels(self.levels)
        self.solvers.update(self.generators)

    @torch.no_grad()
    def evaluation(self) -> None:
        """Their return on the validation levels."""
        self.task.evaluate(self.solvers.agent, self.validation, self.generators[0])

    @torch.no_grad()
    def probing(self) -> None:
        """What the Proposer sees of them."""
        self.task.probe(self.solvers.agent, self.probes)

    def table(self, title: str) -> Table:
        """Milliseconds of each part."""
        whole = sum(Spread.of(times).median for times in self.seconds.values())
        lines = []
        for part, times in self.seconds.items():
            took = Spread.of(times)
            cells = [f"{1e3 * s:.1f}" for s in (took.median, took.low, took.high)]
            lines.append([part, f"{took.median / whole:.1%}", *cells])
        return Table(title, ["part", "share", "median ms", "from", "to"], lines)


def memory(options: Options) -> Result:
    """Peak resident memory of what a run does at the paper's values.

    The steps of a meta-episode follow one another in the same memory; so two are run, and the
    Proposer is trained on an episode of full length that repeats them.
    """
    name, scale = ("tiny", TINY) if options.tiny else ("paper", PAPER)
    length, steps = scale.proposer.lookahead, 2
    task = scale.task(options)
    before = peak_memory()
    short = replace(scale, proposer=replace(scale.proposer, lookahead=steps))
    curriculum = proposer_curriculum(task, _acting_at_every_update(short))
    # The Solver itself, its levels and measurements are in memory beside its copies.
    solver = task.solvers([Streams(0, "solver")])
    curriculum.env.fork(solver.snapshot()[0], Streams(1))
    rollout = curriculum.proposer.collect()
    after_steps = peak_memory()
    long = rollout[:, torch.arange(length) % steps]
    trainer = PPO(
        curriculum.env,
        curriculum.proposer.agent,
        replace(curriculum.proposer.settings, updates=1, epochs=2),
    )
    trainer.optimise(long)
    task.measure(solver.agent)
    peak = peak_memory()
    row = Row(
        f"peak memory of a run, K = {scale.proposer.rollouts}, {name} values",
        f"resident, {scale.precision(options)}",
        Spread.of([peak / 2**30]),
        "GiB",
        target=None if options.tiny else 4.0,
        at_most=True,
    )
    lines = [
        ["libraries and the task", f"{before / 2**30:.2f}"],
        ["... and meta-environment steps", f"{after_steps / 2**30:.2f}"],
        ["... and the Proposer's training", f"{peak / 2**30:.2f}"],
    ]
    return Result([row], [Table("Peak resident memory", ["after", "GiB"], lines)])


def peak_memory() -> int:
    """Most bytes of memory that this process has had at any time."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS counts bytes, every other system kibibytes.
    return peak if sys.platform == "darwin" else 1024 * peak


def _acting_at_every_update(scale: Scale) -> Scale:
    """The same with one update for each action: the shortest steps, and the most of them."""
    return replace(scale, proposer=replace(scale.proposer, updates_per_step=1))


def proposer_curriculum(task: MazeTask, scale: Scale) -> ProposerCurriculum:
    """The curriculum of the method `perf_gain`."""
    curriculum: Any = proposer(Parts(task, scale.proposer, seed=0), performance_gain)
    return curriculum
