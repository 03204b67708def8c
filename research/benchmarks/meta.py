"""One meta-environment step against its parts, and the memory of a run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from proposer_rl.cli.build import Made
from proposer_rl.curricula import ProposerTrainer
from proposer_rl.learning import PPO
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.streams import Streams
from research.benchmarks.memory import peak_memory
from research.benchmarks.results import Options, Result, Row, Spread, Table
from research.benchmarks.scales import PAPER, QUICK, TINY, paper
from research.benchmarks.timing import Timings, interleave, ratio, threads, total

PARTS = ("generation", "update", "evaluation", "probing")
# The shortest steps, and the most of them.
EVERY_UPDATE = "proposer.action_repeat=1"


def meta_step(options: Options) -> Result:
    """A step through TorchRL's interface against what it is made of, called by hand."""
    scales = [TINY] if options.tiny else [QUICK.but("proposer.rollouts=16")]
    if options.size == "full":
        scales.append(PAPER)
    rows, tables = [], []
    for scale in scales:
        made = scale.made(options, EVERY_UPDATE)
        env = trainer_of(made).env
        with threads(scale.threads):
            rounds = options.few if scale == PAPER else options.repeats
            seconds = step_and_parts(env, rounds, options.device)
        size = f"K = {env.batch_size[0]}, {scale.name} values, {made.task.precision}"
        rows.append(
            Row(
                f"a meta-environment step, {size}",
                "the sum of its parts",
                ratio(seconds["step"], total(seconds, dict.fromkeys(PARTS, 1.0))),
                "x",
                target=1.05,
                at_most=True,
                samples=seconds,
            )
        )
        tables.append(parts_table(f"Parts of a meta-environment step, {size}", seconds))
    return Result(rows, tables)


def step_and_parts(env: SolverTrainingEnv, rounds: int, device: str) -> Timings:
    """A step, as ``step``, and what it consists of, timed in turns."""
    step = MetaStep(env)
    return interleave({name: getattr(step, name) for name in ("step", *PARTS)}, rounds, device)


class MetaStep:
    """A step, and what it consists of without the environment around it."""

    def __init__(self, env: SolverTrainingEnv) -> None:
        self.env = env
        self.state = env.reset()
        self.solvers = env.solvers
        self.task = env.view.task
        self.streams = [Streams(copy, "bench") for copy in range(env.batch_size[0])]
        self.generators = [stream.generator() for stream in self.streams]

    @torch.no_grad()
    def step(self) -> None:
        """Step every Solver once with random actions, as a collector does."""
        action = self.env.action_spec.rand()
        _, self.state = self.env.step_and_maybe_reset(self.state.set("action", action))

    def generation(self) -> None:
        """Levels for random actions."""
        action, count = self.env.action_spec.rand(), self.env.batch_of_levels
        self.levels, _ = self.env.actions.levels(action, count, self.streams)

    def update(self) -> None:
        """One PPO update of each Solver on them."""
        self.solvers.env.set_levels(self.levels)
        self.solvers.update(self.generators)

    @torch.no_grad()
    def evaluation(self) -> None:
        """How they do on the validation levels."""
        self.task.performance(self.solvers.agent, self.env.view.validation, self.generators[0])

    @torch.no_grad()
    def probing(self) -> None:
        """What the Proposer sees of them."""
        self.task.probe(self.solvers.agent, self.env.view.probes)


def parts_table(title: str, seconds: Timings) -> Table:
    """Milliseconds of each part of a step."""
    spreads = {part: Spread.of(seconds[part]) for part in PARTS}
    whole = sum(took.median for took in spreads.values())
    lines = []
    for part, took in spreads.items():
        cells = [f"{1e3 * s:.1f}" for s in (took.median, took.low, took.high)]
        lines.append([part, f"{took.median / whole:.1%}", *cells])
    return Table(title, ["part", "share", "median ms", "from", "to"], lines)


def memory(options: Options) -> Result:
    """Peak resident memory of what a run does at the paper's values.

    The steps of a meta-episode follow one another in the same memory; so two are run, and the
    Proposer is trained on an episode of full length that repeats them.
    """
    scale, steps = paper(options), 2
    before = peak_memory()
    # The Solver itself, its levels and measurements are in memory beside its copies.
    made = scale.made(options, EVERY_UPDATE, f"proposer.meta_episode_length={steps}")
    proposer = trainer_of(made).learner
    proposer.env.fork(made.learner.snapshot()[0], Streams(1))
    rollout = proposer.collect()
    after_steps = peak_memory()
    long = rollout[:, torch.arange(scale.config.proposer.meta_episode_length) % steps]
    few = replace(proposer.settings, updates=1, epochs=2)
    PPO(proposer.env, proposer.agent, few).optimise(long)
    made.task.measure(made.learner.agent)
    peak = peak_memory()
    row = Row(
        f"peak memory of a run, K = {scale.config.proposer.rollouts}, {scale.name} values",
        f"resident, {made.task.precision}",
        Spread.of([peak / 2**30]),
        "GiB",
        target=4.0,
        at_most=True,
    )
    lines = [
        ["libraries", f"{before / 2**30:.2f}"],
        ["... and meta-environment steps", f"{after_steps / 2**30:.2f}"],
        ["... and the Proposer's training", f"{peak / 2**30:.2f}"],
    ]
    return Result([row], [Table("Peak resident memory", ["after", "GiB"], lines)])


def trainer_of(made: Made) -> ProposerTrainer:
    """What trains the Proposer of a run of `perf_gain`."""
    curriculum: Any = made.curricula[0]
    trainer: ProposerTrainer = curriculum.trainer
    return trainer
