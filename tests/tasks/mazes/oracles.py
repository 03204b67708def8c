"""Slow and obvious counterparts of what the mazes do in batches."""

from __future__ import annotations

from collections.abc import Iterator

import networkx as nx
import torch

from proposer_rl.tasks.mazes import Level

MOVES = [(-1, 0), (1, 0), (0, -1), (0, 1)]


def random_levels(count: int, height: int, width: int, fraction: float, seed: int) -> Level:
    """Levels of independent obstacles and any path length, also none; start and goal are free."""
    generator = torch.Generator().manual_seed(seed)
    walls = torch.rand(count, height * width, generator=generator) < fraction
    ends = torch.rand(count, height * width, generator=generator).topk(2, dim=1).indices
    walls.scatter_(1, ends, False)
    cells = torch.stack([ends // width, ends % width], dim=-1)
    return Level(
        walls=walls.unflatten(1, (height, width)),
        start=cells[:, 0],
        goal=cells[:, 1],
        batch_size=[count],
    )


def distances(level: Level) -> dict[tuple[int, int], int]:
    """Moves from the start to each cell that can be reached."""
    graph = nx.grid_2d_graph(*level.walls.shape)
    graph.remove_nodes_from([tuple(cell) for cell in level.walls.nonzero().tolist()])
    return dict(nx.single_source_shortest_path_length(graph, tuple(level.start.tolist())))


def path_length(level: Level) -> int:
    """Moves from start to goal, -1 if there is no way."""
    return distances(level).get(tuple(level.goal.tolist()), -1)


def moved(level: Level, cell: tuple[int, int], action: int) -> tuple[int, int]:
    """Where an action leads."""
    row, column = cell[0] + MOVES[action][0], cell[1] + MOVES[action][1]
    height, width = level.walls.shape
    inside = 0 <= row < height and 0 <= column < width
    return (row, column) if inside and not level.walls[row, column] else cell


def play(
    level: Level, actions: list[int], max_steps: int, step_penalty: float
) -> Iterator[tuple[tuple[int, int], float, bool, bool]]:
    """Agent's cell, reward, terminated and truncated of each step, with resets in between."""
    start, goal = tuple(level.start.tolist()), tuple(level.goal.tolist())
    cell, steps = start, 0
    for action in actions:
        cell, steps = moved(level, cell, action), steps + 1
        terminated = cell == goal
        truncated = steps == max_steps and not terminated
        yield cell, float(terminated) - step_penalty, terminated, truncated
        if terminated or truncated:
            cell, steps = start, 0
