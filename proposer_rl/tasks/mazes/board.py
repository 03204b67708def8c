"""Mazes that users draw, and all that a Solver does there: what ``bin/play`` shows of mazes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from proposer_rl.models import ActorCritic, cell_maps
from proposer_rl.task import CellKind
from proposer_rl.tasks.mazes import drawings, evaluation
from proposer_rl.tasks.mazes.grid_task import GridTask
from proposer_rl.tasks.mazes.levels import (
    FREE,
    GOAL,
    START,
    WALL,
    Level,
    cell_index,
    cell_plane,
    planes,
    shortest_way,
    successors,
)

DIGITS = 4  # of the numbers of a map: what can be seen


class Drawings:
    """Mazes as drawings: of a :class:`~proposer_rl.task.Board` all but what a Solver does.

    Args:
        task: whose levels are drawn.
    """

    sets = tuple(drawings.SETS)

    def __init__(self, task: GridTask) -> None:
        self._task = task
        self.size = task.grid

    def read(self, rows: Sequence[str]) -> Any:
        """Returns the level that is drawn; see :class:`~proposer_rl.task.Board`."""
        level = self._task.level.from_text("\n".join(rows))
        self._task.check_level("drawn", level)
        return level

    def draw(self, level: Level) -> list[str]:
        """Returns the rows of a level's drawing."""
        return str(level.to_text()).splitlines()

    def drawing(self, record: Mapping[str, Any]) -> list[str]:
        """Returns the rows of a record's level, without the Solver's path."""
        return drawings.recorded_drawing(record["text"])

    def level_set(self, name: str) -> Mapping[str, Level]:
        """Returns the levels of a shipped set; an agent that turns looks to the right."""
        return drawings.read_levels(drawings.SETS[name], self._task.level)

    def read_file(self, text: str) -> Mapping[str, Level]:
        """Returns the levels of a file's text; docs/how_to/levels.md has the format."""
        return drawings.levels_from_text(text, kind=self._task.level)

    def write_file(self, name: str, level: Level) -> str:
        """Returns a file's text; docs/how_to/levels.md has the format."""
        return drawings.levels_to_text({name: level})


class MazeBoard(Drawings):
    """Mazes that are seen whole; a :class:`~proposer_rl.task.Board`."""

    kinds = (
        CellKind(FREE, "free"),
        CellKind(WALL, "wall"),
        CellKind(START, "start", once=True),
        CellKind(GOAL, "goal", once=True),
    )
    actions = ("up", "down", "left", "right")

    @torch.no_grad()
    def examine(
        self, agent: ActorCritic, solver: int, level: Level, max_steps: int | None
    ) -> dict[str, Any]:
        """Returns what a Solver does on a level, exactly; see :class:`~proposer_rl.task.Board`.

        ``results``: ``success``, ``return`` and ``steps`` (expected) of the sampled policy.
        ``maps``: the critic's values; the probability of success from every cell with the whole
        step limit; how often a step of an episode begins there.
        """
        shortest = shortest_path(level)
        steps, step_penalty = len(shortest or [0]) - 1, self._task.maze.step_penalty
        limit = max_steps or self._task.step_limit(steps)
        level = level.to(self._task.device)
        copies = planes(level.expand(agent.copies, 1))
        logits, values = (each[solver, 0] for each in cell_maps(agent, copies))
        logits, values = logits.float(), values[0].float()
        policy = logits.softmax(0)
        visits = evaluation.expected_visits(level, policy, limit)
        results = evaluation.ExactEvaluator(limit, step_penalty)(level, logits)
        goal = cell_plane(level.goal, level.walls.shape).bool()
        maps = {
            "critic's value": (values, level.walls | goal),
            "success from here": (evaluation.success_from_cells(level, policy, limit), level.walls),
            "expected visits": (visits, level.walls),
        }
        path = evaluation.policy_path(level, logits, limit).tolist()
        return {
            "results": {
                "success": float(results["success"]),
                "return": float(results["return"]),
                "steps": float(visits.sum()),
            },
            "policy": _numbers(policy, level.walls | goal),
            "maps": {name: _numbers(*values) for name, values in maps.items()},
            "paths": {"solver": _until_it_ends(path, level.goal.tolist()), "shortest": shortest},
            "next": successors(level).tolist(),
            "goal": level.goal.tolist(),
            "max_steps": limit,
            "step_penalty": step_penalty,
            "missed": -step_penalty * limit,
        }


def shortest_path(level: Level) -> list[list[int]] | None:
    """Returns a shortest path of a level ``[]``: its cells (row, column), start to goal.

    Returns:
        Of several the one whose moves come first in
        :data:`~proposer_rl.tasks.mazes.levels.MOVES`; None where there is no path.
    """
    width = level.walls.shape[1]
    start, goal = (int(cell_index(cell, width)) for cell in (level.start, level.goal))
    path = shortest_way(successors(level).tolist(), start, lambda cell: cell == goal)
    return None if path is None else [list(divmod(cell, width)) for cell in path]


def _until_it_ends(path: list[list[int]], goal: list[int]) -> list[list[int]]:
    """Returns a path up to the goal, or to the first cell that is entered again."""
    seen: set[tuple[int, ...]] = set()
    for length, cell in enumerate(path, 1):
        if cell == goal or tuple(cell) in seen:
            return path[:length]
        seen.add(tuple(cell))
    return path


def _numbers(values: Tensor, without: Tensor) -> list[list[Any]]:
    """Returns values ``[*A, H, W]`` as lists [H][W][*A]; None in cells of ``without``."""
    rows = values.movedim((-2, -1), (0, 1)).double().round(decimals=DIGITS).tolist()
    return [
        [None if left_out else value for value, left_out in zip(row, line, strict=True)]
        for row, line in zip(rows, without.tolist(), strict=True)
    ]
