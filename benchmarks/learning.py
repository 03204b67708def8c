"""Does bf16 learn as well as fp32? Learning curves of the same seeds, side by side."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.results import Options, Result, Row, Spread, Table
from benchmarks.scales import PAPER, QUICK, TINY
from benchmarks.timing import threads
from proposer_rl.mazes.task import DistributionSettings, EvaluationSettings, MazeTask
from proposer_rl.streams import Streams

# An easy mix, so that something is learnt in few updates.
MIX = DistributionSettings(specifications=[(0.0, 2), (0.1, 3), (0.2, 4), (0.25, 5), (0.3, 6)])

# The paper's network and step size, which is where bf16 pays, on mazes and batches of `quick`.
WIDE = replace(
    QUICK,
    solver=replace(
        PAPER.solver,
        problems=QUICK.solver.problems,
        ppo=replace(PAPER.solver.ppo, horizon=QUICK.solver.ppo.horizon),
    ),
)


def learning_curves(options: Options) -> Result:
    """Train Solvers of the paper's width in both precisions: same levels, same random numbers."""
    scale = TINY if options.tiny else WIDE
    updates, every = (4, 2) if options.tiny else (100, 10)
    seeds = max(2, options.repeats)
    curves = {}
    for precision in ("fp32", "bf16"):
        task = MazeTask(
            maze=scale.maze,
            distributions={"mix": MIX if not options.tiny else scale.distributions["id"]},
            target="mix",
            space=scale.space,
            solver=scale.solver,
            evaluation=EvaluationSettings(distributions=["mix"], levels=8 if options.tiny else 512),
            device=options.device,
            precision=precision,
        )
        with threads(scale.threads):
            curves[precision] = train(task, seeds, updates, every)
    full, low = curves["fp32"], curves["bf16"]
    # Both precisions share their seeds, so the spread between seeds is that of each alone.
    spread = torch.stack([full.std(1), low.std(1)]).mean(0)
    difference = low.mean(1) - full.mean(1)
    error = spread * (2 / seeds) ** 0.5
    score = [float(d.abs() / e.clamp_min(1e-3)) for d, e in zip(difference, error, strict=True)]
    lines = [
        [str(every * i), *(_cell(curve[i]) for curve in curves.values()), f"{difference[i]:+.3f}"]
        for i in range(len(full))
    ]
    row = Row(
        f"bf16 minus fp32, mean curves of {seeds} seeds, {updates} updates",
        "standard error between seeds, along the curve",
        Spread.of(score),
        "x",
        target=None if options.tiny else 2.0,
        at_most=True,
    )
    header = ["update", "fp32 success (min-max)", "bf16 success (min-max)", "difference"]
    return Result(
        [row],
        [Table("Learning curves, the paper's network, quick mazes, an easy mix", header, lines)],
    )


def train(task: MazeTask, seeds: int, updates: int, every: int) -> Tensor:
    """Success rates along training, [measurements, seeds]; the first is before it."""
    streams = [Streams(seed, "learning") for seed in range(seeds)]
    solvers = task.solvers(streams)
    shape = torch.Size([seeds, task.solver.problems])
    curve = [task.measure(solvers.agent)["mix_success"]]
    for update in range(updates):
        levels = [task.sample_target(shape[1], s.generator("levels", update)) for s in streams]
        stacked: object = torch.stack(levels)  # type: ignore[arg-type]
        solvers.env.set_levels(stacked)
        solvers.update([s.generator("actions", update, device=task.device) for s in streams])
        if (update + 1) % every == 0:
            curve.append(task.measure(solvers.agent)["mix_success"])
    return torch.stack(curve).cpu()


def _cell(success: Tensor) -> str:
    return f"{success.mean():.3f} ({success.min():.2f}-{success.max():.2f})"
