"""Exact evaluation of K Solvers on the validation levels."""

from __future__ import annotations

import torch

from proposer_rl.models import cell_logits
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import planes
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator
from research.benchmarks.results import Options, Result, Row
from research.benchmarks.scales import Solvers, paper
from research.benchmarks.timing import interleave, ratio

PAPERS_LEVELS = 75  # of the paper's validation batch, which is evaluated after every update


def exact_evaluation(options: Options) -> Result:
    """The evaluation of a meta-environment step against one update of one Solver."""
    scale = paper(options)
    task = scale.task(options)
    copies, count = scale.config.proposer.rollouts, PAPERS_LEVELS
    generator = Streams(0, "validation").generator()
    validation = task.target.sample(count, generator)
    solver, population = Solvers(task), Solvers(task, copies, batches=1)
    agent = population.ppo.agent
    levels = validation.expand(copies, count)
    logits = cell_logits(agent, planes(levels))
    evaluator = ExactEvaluator(task.maze.max_steps, task.maze.step_penalty)

    @torch.no_grad()
    def whole() -> None:
        task.performance(agent, validation, generator)

    candidates = {
        "update": solver.update,
        "evaluation": lambda: evaluator(levels, logits),
        "with the network": whole,
    }
    seconds = interleave(candidates, options.repeats, options.device)
    rows = [
        Row(
            f"exact evaluation, K = {copies}, E = {count}",
            f"a Solver update, {task.precision}",
            ratio(seconds["evaluation"], seconds["update"]),
            "%",
            target=0.03,
            at_most=True,
            samples=seconds,
        ),
        Row(
            "... with the forward passes for its policies",
            f"{copies} x a Solver update, {task.precision}",
            ratio(seconds["with the network"], seconds["update"], 1 / copies),
            "%",
            samples=seconds,
        ),
    ]
    note = (
        f"The second row is the evaluation's part in a meta-environment step: {copies} Solvers are "
        f"updated for each evaluation. Its forward passes alone cover {copies * count:,} levels."
    )
    return Result(rows, notes=[note])
