"""How a Solver does on named levels, one by one and exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Any

import torch

from proposer_rl.mazes import Level, planes, shortest_path_length
from proposer_rl.mazes.evaluation import ExactEvaluator, policy_path
from proposer_rl.models import ActorCritic, cell_logits

AT_ONCE = 2**17  # cells that go through the network together


@dataclass(frozen=True)
class Score:
    """What one Solver does on one level.

    Attributes:
        level: Its name.
        solver: The Solver's number among those of a population.
        height, width: Of the grid, in cells.
        path_length: Moves on the shortest path.
        max_steps: Steps after which an episode is truncated.
        success: Probability that the sampled policy reaches the goal.
        mean_return: Of the sampled policy, undiscounted.
        greedy_success: 1 or 0: whether the most probable actions lead to the goal.
        greedy_return: Of the greedy policy.
        path: Cells (row, column) that the greedy policy visits.
    """

    level: str
    solver: int
    height: int
    width: int
    path_length: int
    max_steps: int
    success: float
    mean_return: float
    greedy_success: float
    greedy_return: float
    path: list[list[int]]


@torch.no_grad()
def score_levels(
    solver: ActorCritic,
    levels: Mapping[str, Level],
    max_steps: Callable[[int], int],
    step_penalty: float = 0.01,
    device: torch.device | str = "cpu",
) -> list[Score]:
    """Evaluates Solvers on levels of any size, exactly (:class:`ExactEvaluator`).

    The network maps a grid of any size to one of that size. Levels of one size and one step limit
    go through it together.

    Args:
        solver: K Solvers, from :func:`~proposer_rl.models.map_actor_critic` of a population.
        levels: Levels of batch shape ``[]`` by their names.
        max_steps: The step limit of a level, given the length of its shortest path.
        step_penalty: Cost of a step.
        device: That of the Solvers.

    Returns:
        One score for each level and Solver, in the levels' order.
    """
    groups: dict[tuple[int, int, int], list[str]] = {}
    lengths = {name: int(shortest_path_length(level)) for name, level in levels.items()}
    for name, level in levels.items():
        height, width = level.walls.shape
        groups.setdefault((height, width, max_steps(lengths[name])), []).append(name)
    scores: list[Score] = []
    for (height, width, limit), members in groups.items():
        remaining = iter(members)
        while names := list(islice(remaining, max(AT_ONCE // (height * width), 1))):
            batch: Any = torch.stack([levels[name] for name in names])
            batch = batch.to(device)
            named = [(name, lengths[name]) for name in names]
            scores += _scored(solver, batch, named, limit, step_penalty)
    place = {name: number for number, name in enumerate(levels)}
    return sorted(scores, key=lambda score: (place[score.level], score.solver))


def _scored(
    solver: ActorCritic,
    levels: Level,
    named: list[tuple[str, int]],
    limit: int,
    step_penalty: float,
) -> Iterator[Score]:
    """Scores of K Solvers on n levels [n], given their names and shortest paths."""
    height, width = levels.walls.shape[-2:]
    copies = levels.expand(solver.copies, *levels.batch_size)  # [K, n]
    logits = cell_logits(solver, planes(copies))
    sampled = ExactEvaluator(limit, step_penalty)(copies, logits)
    greedy = ExactEvaluator(limit, step_penalty, greedy=True)(copies, logits)
    paths = policy_path(copies, logits, limit)  # [K, n, limit + 1, 2]
    for k in range(len(copies)):
        for i, (name, length) in enumerate(named):
            yield Score(
                level=name,
                solver=k,
                height=height,
                width=width,
                path_length=length,
                max_steps=limit,
                success=float(sampled["success"][k, i]),
                mean_return=float(sampled["return"][k, i]),
                greedy_success=float(greedy["success"][k, i]),
                greedy_return=float(greedy["return"][k, i]),
                path=_until(levels.goal[i].tolist(), paths[k, i].tolist()),
            )


def _until(goal: list[int], path: list[list[int]]) -> list[list[int]]:
    """A path up to its first visit of the goal."""
    return path[: path.index(goal) + 1] if goal in path else path
