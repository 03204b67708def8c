"""Levels per second, and shortest paths per second."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from proposer_rl.tasks.mazes import Level, LevelDistribution, generate_levels, shortest_path_length
from proposer_rl.tasks.mazes.levels import cell_index
from research.benchmarks.results import Options, Result, Row
from research.benchmarks.scales import paper
from research.benchmarks.timing import interleave, rate, ratio

BATCH = 2048


def generation(options: Options) -> Result:
    """Levels as specified, against drawing walls, start and goal without regard to the path."""
    task, batch = paper(options).task(options), 8 if options.tiny else BATCH
    generator = torch.Generator(options.device).manual_seed(0)
    sources: dict[str, tuple[LevelDistribution, float | None]] = {
        "ID": (task.target, 200e3),
        f"mix of {task.space.size} bins": (task.space, 100e3),
        "OOD": (task.distributions["ood"], None),
    }
    for distribution, _ in sources.values():
        check_exact(distribution, batch, generator)
    height, width = task.maze.height, task.maze.width
    ((fraction, _),) = task.target.specifications
    candidates: dict[str, Callable[[], object]] = {
        "uncontrolled": partial(
            uncontrolled, batch, round(fraction * height * width), height, width, generator
        )
    }
    for name, (distribution, _) in sources.items():
        candidates[name] = partial(distribution.sample, batch, generator)
    seconds = interleave(candidates, 4 * options.repeats, options.device)
    rows = []
    for name, (_, target) in sources.items():
        rows.append(
            Row(
                f"levels, {name}, batches of {batch:,}",
                "each as specified",
                rate(batch, seconds[name]),
                "/s",
                target=target,
                samples={name: seconds[name]},
            )
        )
        rows.append(
            Row(
                f"time of a level, {name}",
                "random walls, no control of the path",
                ratio(seconds[name], seconds["uncontrolled"]),
                "x",
                samples={name: seconds[name], "uncontrolled": seconds["uncontrolled"]},
            )
        )
    return Result(rows)


def check_exact(distribution: LevelDistribution, count: int, generator: torch.Generator) -> None:
    """Raise AssertionError unless every level drawn is what its specification says."""
    device = generator.device
    index = torch.arange(count, device=device) % distribution.size
    levels = distribution.generate(index, generator)
    fraction, length = distribution.decode(index)
    obstacles = (fraction * distribution.height * distribution.width).round().long()
    if not (
        torch.equal(levels.walls.sum((-2, -1)), obstacles)
        and torch.equal(shortest_path_length(levels), length)
    ):
        raise AssertionError("levels were generated that are not as specified")


def uncontrolled(
    batch: int, obstacles: int, height: int, width: int, generator: torch.Generator
) -> Level:
    """Levels of random walls, start and goal, as generators without a path length make them."""
    order = torch.rand(batch, height * width, generator=generator, device=generator.device).argsort(
        -1
    )
    walls = torch.zeros_like(order, dtype=torch.bool)
    walls.scatter_(-1, order[:, :obstacles], True)
    cells = [order[:, obstacles + i] for i in range(2)]
    start, goal = (torch.stack([cell // width, cell % width], -1) for cell in cells)
    return Level(walls.unflatten(-1, (height, width)), start, goal, batch_size=[batch])


def shortest_paths(options: Options) -> Result:
    """Batched shortest paths against networkx and scipy."""
    rows = []
    for side in (5,) if options.tiny else (10, 13):
        batch, few = (8, 4) if options.tiny else (BATCH, 64)
        generator = torch.Generator().manual_seed(side)
        length = 4 if options.tiny else 12
        levels = generate_levels(torch.full((batch,), 0.4), length, side, side, generator=generator)
        ready, graph = [_graph(level) for level in levels[:few]], _joint_graph(levels)
        references: dict[str, tuple[Callable[[], list[int]], int, float | None]] = {
            "networkx, graph and search": (partial(_search_from_walls, levels[:few]), few, 100),
            "networkx, search alone": (partial(_search, ready), few, None),
            "scipy, search alone": (partial(_joint_search, graph), batch, None),
        }
        for name, (search, count, _) in references.items():
            if search() != [length] * count:
                raise AssertionError(f"{name}: other lengths than the levels were made with")
        levels = levels.to(options.device)
        if not bool((shortest_path_length(levels) == length).all()):
            raise AssertionError("other lengths than the levels were made with")
        candidates: dict[str, Callable[[], object]] = {
            "here": partial(shortest_path_length, levels),
            **{name: search for name, (search, _, _) in references.items()},
        }
        seconds = interleave(candidates, 2 * options.repeats, options.device)
        for name, (_, count, target) in references.items():
            rows.append(
                Row(
                    f"speed of shortest paths, {side}x{side}, {batch:,} mazes",
                    name,
                    ratio(seconds[name], seconds["here"], batch / count),
                    "x",
                    target=target,
                    samples={"here": seconds["here"], name: seconds[name]},
                )
            )
    note = (
        "Shortest paths here start from the walls, as networkx does where it makes its graph; "
        "alone, it and scipy (one call for all mazes) search in graphs made beforehand."
    )
    return Result(rows, notes=[note])


def _graph(level: Level) -> tuple[Any, tuple[int, ...], tuple[int, ...]]:
    """A maze for networkx: graph of the free cells, start, goal."""
    import networkx

    graph = networkx.grid_2d_graph(*level.walls.shape)
    graph.remove_nodes_from([tuple(cell) for cell in level.walls.nonzero().tolist()])
    return graph, tuple(level.start.tolist()), tuple(level.goal.tolist())


def _search_from_walls(levels: Level) -> list[int]:
    return _search([_graph(level) for level in levels])


def _search(problems: list[tuple[Any, tuple[int, ...], tuple[int, ...]]]) -> list[int]:
    import networkx

    return [networkx.shortest_path_length(*problem) for problem in problems]


def _joint_graph(levels: Level) -> tuple[Any, Any, Any]:
    """All mazes for scipy: one graph without edges between them, starts, goals."""
    from scipy.sparse import coo_array

    height, width = levels.walls.shape[1:]
    size = height * width
    origin = torch.arange(len(levels)) * size
    starts, goals = (origin + cell_index(cell, width) for cell in (levels.start, levels.goal))
    edges = torch.cat([_edges(levels.walls, axis) for axis in (1, 2)], 1).numpy()
    shape = (len(levels) * size,) * 2
    graph = coo_array((torch.ones(edges.shape[1]).numpy(), tuple(edges)), shape).tocsr()
    return graph, starts.numpy(), goals.numpy()


def _joint_search(problem: tuple[Any, Any, Any]) -> list[int]:
    from scipy.sparse.csgraph import dijkstra

    graph, starts, goals = problem
    distance = dijkstra(graph, directed=False, indices=starts, unweighted=True, min_only=True)
    return distance[goals].astype(int).tolist()


def _edges(walls: Tensor, axis: int) -> Tensor:
    """Pairs of neighbouring free cells along an axis, numbered through all mazes: int64 [2, n]."""
    free = ~walls
    number = torch.arange(walls.numel()).view(walls.shape)
    length = walls.shape[axis] - 1
    both = free.narrow(axis, 0, length) & free.narrow(axis, 1, length)
    return torch.stack([number.narrow(axis, i, length)[both] for i in range(2)])
