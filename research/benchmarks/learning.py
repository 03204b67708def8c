"""Does bf16 learn as well as fp32? Learning curves of the same seeds, side by side."""

from __future__ import annotations

import torch
from torch import Tensor

from research.benchmarks.results import Options, Result, Row, Spread, Table
from research.benchmarks.scales import QUICK, TINY, Scale
from research.benchmarks.timing import threads

# The paper's network and step size, which is where bf16 pays, on mazes and batches of `quick`; an
# easy mix, so that something is learnt in few updates.
WIDE = QUICK.but(
    "task.network.channels=[64,128,256]",
    "solver.ppo.learning_rate=2.5e-4",
    "task.distributions.mix.specifications=[[0.0,2],[0.1,3],[0.2,4],[0.25,5],[0.3,6]]",
)


def learning_curves(options: Options) -> Result:
    """Train Solvers of the paper's width in both precisions: same levels, same random numbers."""
    scale = TINY if options.tiny else WIDE
    updates, every = (4, 2) if options.tiny else (100, 10)
    seeds = max(2, options.repeats)
    full, low = (
        train(scale, options, precision, seeds, updates, every) for precision in ("fp32", "bf16")
    )
    # Both precisions share their seeds, so the spread between seeds is that of each alone.
    spread = torch.stack([full.std(1), low.std(1)]).mean(0)
    difference = low.mean(1) - full.mean(1)
    error = spread * (2 / seeds) ** 0.5
    score = [float(d.abs() / e.clamp_min(1e-3)) for d, e in zip(difference, error, strict=True)]
    lines = [
        [str(every * i), _cell(full[i]), _cell(low[i]), f"{difference[i]:+.3f}"]
        for i in range(len(full))
    ]
    row = Row(
        f"bf16 minus fp32, mean curves of {seeds} seeds, {updates} updates",
        "standard error between seeds, along the curve",
        Spread.of(score),
        "x",
        target=2.0,
        at_most=True,
    )
    header = ["update", "fp32 success (min-max)", "bf16 success (min-max)", "difference"]
    return Result(
        [row],
        [Table("Learning curves, the paper's network, quick mazes, an easy mix", header, lines)],
    )


def train(
    scale: Scale, options: Options, precision: str, seeds: int, updates: int, every: int
) -> Tensor:
    """Success rates along training, [measurements, seeds]; the first is before it."""
    of_run = (
        f"precision={precision}",
        f"seeds={list(range(seeds))}",
        "task.target=mix",
        "task.evaluation.distributions=[mix]",
        f"schedule.updates={updates}",
        f"schedule.evaluate_every={every}",
    )
    target = Scale(scale.name, "target", scale.overrides)
    with threads(scale.threads):
        rows = target.run(options, target.made(options, *of_run), *of_run)
    return torch.tensor([row["mix_success"] for row in rows]).view(-1, seeds)


def _cell(success: Tensor) -> str:
    return f"{success.mean():.3f} ({success.min():.2f}-{success.max():.2f})"
