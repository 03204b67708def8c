"""Levels in which an agent looks in a direction."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from proposer_rl.tasks.mazes.levels import START, Level

AGENTS = (">", "v", "<", "^")
"""The agent in a drawing, by its direction: 0 right, 1 down, 2 left, 3 up."""

AHEAD = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Change of row and column on moving forward, by direction."""


class ViewLevel(Level):
    """Mazes whose agent begins in a direction, of any batch shape ``[*B]``.

    In a drawing the start is one of ``>``, ``v``, ``<`` and ``^``, the direction in which the agent
    looks; with an ``S`` it looks to the right.

    Attributes:
        direction: int64 ``[*B]``, 0 right, 1 down, 2 left, 3 up.
    """

    direction: Tensor

    @classmethod
    def _parse(cls, drawing: str) -> ViewLevel:
        marks = [mark for mark in drawing if mark in AGENTS]
        for mark in AGENTS:
            drawing = drawing.replace(mark, START)
        direction = AGENTS.index(marks[0]) if marks else 0
        return directed(Level.from_text(drawing), torch.tensor(direction))

    def to_text(self) -> Any:
        """Draws the levels with one character per cell; the inverse of :meth:`from_text`.

        Example:
            >>> level = ViewLevel.from_text('''
            ... v.#
            ... #.G
            ... ''')
            >>> level.direction
            tensor(1)
            >>> print(level.to_text())
            v.#
            #.G
        """
        text = super().to_text()
        return text if self.batch_dims else text.replace(START, AGENTS[int(self.direction)])


def directed(level: Level, direction: Tensor) -> ViewLevel:
    """Levels [*B] with the directions in which their agents begin, int64 [*B]."""
    return ViewLevel(
        walls=level.walls,
        start=level.start,
        goal=level.goal,
        direction=direction,
        batch_size=level.batch_size,
    )
