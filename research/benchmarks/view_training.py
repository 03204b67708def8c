"""Whole training on the partially observable maze at the published numbers, beside jaxued's."""

from __future__ import annotations

from dataclasses import asdict, replace

import torch

from proposer_rl.models.population import available_cores
from proposer_rl.streams import Streams
from research.benchmarks.jaxued_peer import TRAINING
from research.benchmarks.peer import jaxued_maze
from research.benchmarks.results import Options, Result, Row
from research.benchmarks.scales import Scale, Solvers
from research.benchmarks.timing import interleave, rate, ratio, threads

PUBLISHED = Scale("paper", "domain_randomization", ("task=view_maze",))
SMALL = Scale("paper", "domain_randomization", ("task=view_maze_smoke",))
CORES = (1, 2)


def view_training(options: Options) -> Result:
    """Frames per second of updates in fp32: a rollout, advantages, and all gradient steps."""
    options = replace(options, precision="fp32")
    result = Result([])
    for cores in CORES if options.device == "cpu" else [None]:
        if cores is None or cores <= available_cores():
            with threads(cores):
                beside = on_these_cores(SMALL if options.tiny else PUBLISHED, options)
            result.rows += beside.rows
            result.notes += beside.notes
    return result


def on_these_cores(scale: Scale, options: Options) -> Result:
    """Ours, and in turn with it jaxued's where there is one, with as many cores as torch's threads.

    Raises:
        RuntimeError: As :func:`research.benchmarks.peer.jaxued_maze`.
    """
    task = scale.task(options)
    solvers, settings = Solvers(task), task.solver.ppo
    frames = task.batch_size * settings.horizon
    where = f"{task.batch_size} x {settings.horizon} steps, {torch.get_num_threads()} thread(s)"
    what = f"training in the view maze, {where}"
    if options.jaxued is None:
        seconds = interleave({"update": solvers.update}, options.few, options.device)
        fast = rate(frames, seconds["update"])
        return Result([Row(what, f"frames, {settings.epochs} epochs", fast, "/s", samples=seconds)])
    levels = task.target.sample(task.batch_size, Streams(0, "levels").generator())
    actions = torch.zeros(settings.horizon, task.batch_size, dtype=torch.int64)
    numbers = asdict(settings) | scale.config.task["network"]
    with jaxued_maze(options.jaxued, levels, actions, task.maze.max_steps, numbers) as peer:
        seconds = peer.in_turn([TRAINING], {"update": solvers.update}, options.few)
    fast, theirs = (rate(frames, seconds[name]) for name in ("update", TRAINING))
    return Result(
        [
            Row(what, f"frames, {settings.epochs} epochs", fast, "/s", samples=seconds),
            Row(f"jaxued's PPO, {where}", "one jit for an update", theirs, "/s"),
            Row(
                f"speed of {what}",
                "jaxued's PPO",
                ratio(seconds[TRAINING], seconds["update"]),
                "x",
                target=1.5,
            ),
        ],
        notes=[f"{peer.about}; torch with {torch.get_num_threads()} thread(s)."],
    )
