"""One Solver update: against the plain way, in both precisions, and what of it is the network."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from statistics import median

import torch

from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes import MazeEnv
from research.benchmarks.plain import PlainPPO, PlainUNet
from research.benchmarks.results import Options, Result, Row, Spread, Table
from research.benchmarks.scales import NARROW, PAPER, TINY, Scale, Solvers, paper, precisions
from research.benchmarks.timing import interleave, ratio, threads, total

SMALL_BATCH = 16
UNREPLAYED = "compute.graphs=false"


def against_plain(options: Options) -> Result:
    """The library's update and the plain TorchRL one, on the same mazes and network."""
    if options.tiny:
        return _complete(TINY, options)
    if options.size == "full":
        return _complete(PAPER, options)
    small = _complete(PAPER.but(f"solver.batch_size={SMALL_BATCH}"), options)
    paper = _from_parts(PAPER, options)
    return Result(paper.rows + small.rows, paper.tables, paper.notes)


def _complete(scale: Scale, options: Options) -> Result:
    """Both updates from beginning to end."""
    plain = _plain(scale, options)
    candidates = {**_updates(scale, options), "plain": plain.update}
    seconds = interleave(candidates, options.few, options.device)
    rows = [
        _row(scale, name, seconds["plain"], seconds[name], "plain TorchRL way")
        for name in candidates
        if name != "plain"
    ]
    return Result(rows)


def _from_parts(scale: Scale, options: Options) -> Result:
    """The plain update, put together from one collection and one epoch, since it takes a minute."""
    plain, epochs = _plain(scale, options), scale.config.solver.ppo.epochs
    rollout = plain.collect()
    candidates: dict[str, Callable[[], object]] = {
        **_updates(scale, options),
        "plain: collection": plain.collect,
        "plain: advantages": lambda: plain.advantages(rollout),
        "plain: epoch": lambda: plain.epoch(rollout),
    }
    seconds = interleave(candidates, options.few, options.device)
    parts = {"plain: collection": 1, "plain: advantages": 1, "plain: epoch": epochs}
    whole = total(seconds, parts)
    rows = [
        _row(scale, name, whole, seconds[name], "plain TorchRL way, from its parts")
        for name in candidates
        if name not in parts
    ]
    table = Table(
        "Seconds behind the comparison with plain TorchRL, at the paper's values",
        ["what", "median", "from", "to"],
        [[name, *_cells(Spread.of(seconds[name]))] for name in candidates]
        + [["plain: whole update, computed", *_cells(Spread.of(whole))]],
    )
    note = (
        f"The plain update at the paper's values is {epochs} times one of its epochs plus its "
        f"collection and advantages; every epoch does the same work. With P = {SMALL_BATCH}, and "
        "everywhere with --full, it is run from beginning to end."
    )
    return Result(rows, [table], [note])


def in_both_precisions(options: Options) -> Result:
    """The same update with bf16 autocast and without."""
    if precisions(options) == ["fp32"]:
        return Result([], notes=["This machine has no bf16 instructions; fp32 it is."])
    rows = []
    scales = [TINY] if options.tiny else [PAPER, PAPER.but(NARROW)]
    for scale in scales:
        updates = _updates(scale, options)
        seconds = interleave(updates, options.repeats, options.device)
        rows.append(
            Row(
                f"speed of a Solver update, {_size(scale)}, bf16",
                "the same in fp32",
                ratio(seconds["fp32"], seconds["bf16"]),
                "x",
                samples=seconds,
            )
        )
    return Result(rows, notes=["Whether bf16 learns as well is what `learning` measures."])


def population(options: Options) -> Result:
    """K Solvers in one update against K updates of one."""
    limit = 0.35 if options.device.startswith("cuda") else 1.0
    if options.tiny:
        scales = [TINY]
    else:
        scales = [PAPER.but(NARROW)]
        if options.size == "full":
            scales.append(PAPER)
    rows = []
    for scale in scales:
        copies, task = scale.config.proposer.rollouts, scale.task(options)
        alone, together = Solvers(task), Solvers(task, copies)

        def in_turn(count: int | None = None, solver: Solvers = alone, times: int = copies) -> None:
            with threads(count):
                for _ in range(times):
                    solver.update()

        # An operation on small maps may be slower on several threads: the faster way counts.
        ways: dict[str, Callable[[], object]] = {
            "in turn": in_turn,
            "in turn, one thread": partial(in_turn, 1),
        }
        repeats = options.few if scale == PAPER else options.repeats
        seconds = interleave({"together": together.update, **ways}, repeats, options.device)
        best = min((seconds[way] for way in ways), key=median)
        rows.append(
            Row(
                f"one update of K = {copies}, {_size(scale)}, {task.precision}",
                f"{copies} updates of K = 1",
                ratio(seconds["together"], best),
                "x",
                target=limit,
                at_most=True,
                samples=seconds,
            )
        )
    return Result(rows)


def overhead(options: Options) -> Result:
    """What of an update is not the network: environment, GAE, loss, collector, optimiser."""
    scale = paper(options)
    rows = []
    for precision in precisions(options):
        # Both called as they are: on a GPU the network alone would not be replayed.
        own = f"precision={precision}"
        solvers = Solvers(scale.task(options, own, UNREPLAYED))
        agent = solvers.ppo.agent
        level = solvers.ppo.env.reset().select(*agent.level_keys)
        with torch.no_grad():
            maps = agent.encode(level)
        slopes = [torch.randn_like(maps[key]) for key in agent.context_keys]

        def network_alone(agent=agent, level=level, slopes=slopes) -> None:  # type: ignore[no-untyped-def]
            with torch.no_grad():
                agent.encode(level)
            for _ in range(scale.config.solver.ppo.epochs):
                context = agent.encode(level)
                agent.zero_grad()
                torch.autograd.backward([context[key] for key in agent.context_keys], slopes)

        seconds = interleave(
            {"update": solvers.update, "network": network_alone}, options.repeats, options.device
        )
        shares = [1 - n / u for n, u in zip(seconds["network"], seconds["update"], strict=True)]
        rows.append(
            Row(
                f"all but the network, {_size(scale)}, {precision}",
                "a Solver update",
                Spread.of(shares),
                "%",
                target=0.10,
                at_most=True,
                samples=seconds,
            )
        )
    note = (
        "The network's share is one forward pass and as many forward and backward passes as there "
        "are epochs, called alone. Adam and the clipping of gradients count as not the network."
    )
    return Result(rows, notes=[note])


def _updates(scale: Scale, options: Options) -> dict[str, Callable[[], object]]:
    return {
        precision: Solvers(scale.task(options, f"precision={precision}")).update
        for precision in precisions(options)
    }


def _plain(scale: Scale, options: Options) -> PlainPPO:
    task = scale.task(options)
    levels = task.target.sample(task.batch_size, Streams(0, "levels").generator())
    env = MazeEnv(levels, max_steps=task.maze.max_steps)
    return PlainPPO(env, PlainUNet(scale.channels), task.solver.ppo)


def _row(scale: Scale, precision: str, plain: list[float], ours: list[float], against: str) -> Row:
    at_paper_values = scale == PAPER
    return Row(
        f"speed of a Solver update, {_size(scale)}, {precision}",
        against,
        ratio(plain, ours),
        "x",
        target=20 if at_paper_values else None,
        samples={"plain": plain, "update": ours},
    )


def _size(scale: Scale) -> str:
    if scale == PAPER:
        return "paper values"
    channels = "→".join(str(width) for width in scale.channels)
    return f"P = {scale.config.solver.batch_size}, {channels}"


def _cells(seconds: Spread) -> list[str]:
    return [f"{value:.3g}" for value in (seconds.median, seconds.low, seconds.high)]
