"""How a Solver does on named levels, one by one and exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from proposer_rl.models import ActorCritic, cell_logits
from proposer_rl.task import Score
from proposer_rl.tasks.mazes.distance import shortest_path_length
from proposer_rl.tasks.mazes.evaluation import ExactEvaluator, policy_path
from proposer_rl.tasks.mazes.levels import Level, planes
from proposer_rl.tasks.mazes.rendering import draw_level

SLACK = 2  # of a named level: steps allowed for each one of its shortest path
AT_ONCE = 2**17  # cells that go through the network together


@torch.no_grad()
def score_levels(
    agent: ActorCritic,
    levels: Mapping[str, Level],
    max_steps: Callable[[int], int],
    step_penalty: float = 0.01,
    device: torch.device | str = "cpu",
) -> list[Score]:
    """Evaluates Solvers on levels of any size, exactly (:class:`ExactEvaluator`).

    The network maps a grid of any size to one of that size. Levels of one size and one step limit
    go through it together.

    Args:
        agent: K Solvers, from :func:`~proposer_rl.models.map_actor_critic` of a population.
        levels: Levels of batch shape ``[]`` by their names.
        max_steps: The step limit of a level, given the length of its shortest path.
        step_penalty: Cost of a step.
        device: That of the Solvers.

    Returns:
        One score for each level and Solver, in the levels' order. ``about``: ``height``, ``width``,
        ``path_length`` (moves on the shortest path) and ``max_steps``. ``results``: ``success`` and
        ``return`` of the sampled policy, and of the greedy one, which takes the most probable
        actions, ``greedy_success`` (1 or 0) and ``greedy_return``.
    """
    lengths = {name: int(shortest_path_length(level)) for name, level in levels.items()}
    limits = {name: max_steps(length) for name, length in lengths.items()}
    scores: list[Score] = []
    for names, limit in alike(levels, limits, lambda cells: AT_ONCE // cells):
        batch: Any = torch.stack([levels[name] for name in names])
        named = [(name, lengths[name]) for name in names]
        scores += _scored(agent, batch.to(device), named, limit, step_penalty)
    return in_order_of(levels, scores)


def alike(
    levels: Mapping[str, Level], limits: Mapping[str, int], most: Callable[[int], int]
) -> Iterator[tuple[list[str], int]]:
    """Levels of one size and one step limit, which can be looked at together.

    Args:
        levels: Levels of batch shape ``[]`` by their names.
        limits: The step limit of each.
        most: How many go together, given the number of their cells; at least one does.

    Yields:
        Their names, and their step limit.
    """
    groups: dict[tuple[int, int, int], list[str]] = {}
    for name, level in levels.items():
        height, width = level.walls.shape
        groups.setdefault((height, width, limits[name]), []).append(name)
    for (height, width, limit), members in groups.items():
        remaining = iter(members)
        while names := list(islice(remaining, max(most(height * width), 1))):
            yield names, limit


def in_order_of(levels: Mapping[str, Level], scores: Iterable[Score]) -> list[Score]:
    """Scores in the levels' order, those of one level in the Solvers'."""
    place = {name: number for number, name in enumerate(levels)}
    return sorted(scores, key=lambda score: (place[score.level], score.solver))


def _scored(
    agent: ActorCritic,
    levels: Level,
    named: list[tuple[str, int]],
    limit: int,
    step_penalty: float,
) -> Iterator[Score]:
    """Scores of K Solvers on n levels [n], given their names and shortest paths."""
    height, width = levels.walls.shape[-2:]
    copies = levels.expand(agent.copies, *levels.batch_size)  # [K, n]
    logits = cell_logits(agent, planes(copies))
    measured = {
        f"{prefix}{key}": value
        for prefix, greedy in (("", False), ("greedy_", True))
        for key, value in ExactEvaluator(limit, step_penalty, greedy)(copies, logits).items()
    }
    paths = policy_path(copies, logits, limit)  # [K, n, limit + 1, 2]
    for k in range(len(copies)):
        for i, (name, length) in enumerate(named):
            results = {key: float(value[k, i]) for key, value in measured.items()}
            away = (paths[k, i] != levels[i].goal).any(-1)
            path = paths[k, i, : int(away.sum()) + 1].tolist()  # the goal is not left again
            moves = f"greedy {len(path) - 1}" if results["greedy_success"] else "greedy fails"
            about = {"height": height, "width": width, "path_length": length, "max_steps": limit}
            note = f"shortest {length}, {moves}"
            picture = partial(_picture, levels[i], path)
            yield Score(name, k, about, results, note, picture)


def _picture(level: Level, path: list[list[int]]) -> NDArray[np.uint8]:
    return draw_level(level, path).numpy()
