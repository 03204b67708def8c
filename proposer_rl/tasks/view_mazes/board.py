"""Partially observable mazes that users draw, and what a Solver with memory does there."""

from __future__ import annotations

from typing import Any

import torch

from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams
from proposer_rl.task import CellKind
from proposer_rl.tasks.mazes.board import Drawings
from proposer_rl.tasks.mazes.grid_task import GridTask
from proposer_rl.tasks.mazes.levels import (
    FREE,
    GOAL,
    MOVES,
    WALL,
    cell_index,
    shortest_way,
    successors,
)
from proposer_rl.tasks.view_mazes.view_env import PENALTY, fewest_actions, walks
from proposer_rl.tasks.view_mazes.view_levels import AGENTS, AHEAD, ViewLevel

SHOWN = 20  # sampled episodes that can be watched
Node = list[int]  # row, column and direction


class ViewBoard(Drawings):
    """Mazes seen through a window; a :class:`~proposer_rl.task.Board` without policy and maps.

    What a Solver does in a cell depends on what it remembers, so that only episodes can be shown.

    Args:
        task: whose levels are drawn.
        episodes: played on a level to measure a Solver.
        streams: that actions are drawn from, as ``bin/eval`` draws them.
    """

    kinds = (
        CellKind(FREE, "free"),
        CellKind(WALL, "wall"),
        *(CellKind(mark, "start", once=True) for mark in AGENTS),
        CellKind(GOAL, "goal", once=True),
    )
    actions = ("left", "right", "up")  # two turns, and forward

    def __init__(self, task: GridTask, episodes: int, streams: Streams) -> None:
        super().__init__(task)
        self._episodes, self._streams = episodes, streams

    def examine(
        self, agent: ActorCritic, solver: int, level: ViewLevel, max_steps: int | None
    ) -> dict[str, Any]:
        """Returns what a Solver does on a level, by playing; see :class:`~proposer_rl.task.Board`.

        ``results``: means over sampled episodes, those of ``bin/eval`` on a level named ``drawn``.
        """
        limit = max_steps or self._task.step_limit(int(fewest_actions(level)))
        goal, following = level.goal.tolist(), _following(level)
        placed = level.to(self._task.device).expand(self._episodes)
        generator = self._streams.generator("drawn")
        noise = torch.rand(limit, self._episodes, generator=generator).to(self._task.device)
        went, steps = (each[solver] for each in walks(agent, placed, limit, noise))
        best, number = (each[solver, 0] for each in walks(agent, placed[:1], limit))
        sampled = [one[: n + 1].tolist() for one, n in zip(went, steps.tolist(), strict=True)]
        reached = [path[-1][:2] == goal for path in sampled]
        moves = [len(path) - 1 for path in sampled]
        returns = [r * (1 - PENALTY / limit * n) for r, n in zip(reached, moves, strict=True)]
        results = {"success": reached, "return": returns, "steps": moves}
        return {
            "results": {name: sum(each) / self._episodes for name, each in results.items()},
            "episodes": self._episodes,
            "maps": {},
            "paths": {
                "solver": best[: int(number) + 1].tolist(),
                "shortest": _shortest(level, following),
                "sampled": sampled[:SHOWN],
            },
            "next": following,
            "goal": goal,
            "max_steps": limit,
            "step_penalty": PENALTY / limit,
            "missed": 0.0,
        }


def _following(level: ViewLevel) -> list[list[int]]:
    """Returns where each action leads, [3][H * W * 4]; four directions for each cell."""
    moved = successors(level).tolist()  # [4][H * W], in the order of MOVES
    ahead = [moved[MOVES.index(step)] for step in AHEAD]
    cells, ways = range(len(moved[0])), range(len(AHEAD))
    turned = [[4 * cell + (way + turn) % 4 for cell in cells for way in ways] for turn in (-1, 1)]
    return [*turned, [4 * ahead[way][cell] + way for cell in cells for way in ways]]


def _shortest(level: ViewLevel, following: list[list[int]]) -> list[Node] | None:
    """Returns a way of fewest actions, start and goal included; None where there is none."""
    width = level.walls.shape[1]
    start, goal = (int(cell_index(cell, width)) for cell in (level.start, level.goal))
    way = shortest_way(following, 4 * start + int(level.direction), lambda n: n // 4 == goal)
    return None if way is None else [[*divmod(node // 4, width), node % 4] for node in way]
