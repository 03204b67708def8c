"""Levels in which an agent looks in a direction."""

from __future__ import annotations

from collections.abc import Sequence
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

    Attributes:
        direction: int64 ``[*B]``, 0 right, 1 down, 2 left, 3 up.
    """

    direction: Tensor

    @classmethod
    def from_text(cls, text: str | Sequence[str]) -> ViewLevel:
        """Reads levels drawn with one character per cell.

        Args:
            text: As for :meth:`Level.from_text`; the start is one of ``>``, ``v``, ``<`` and ``^``,
                the direction in which the agent looks. With an ``S`` it looks to the right.

        Returns:
            A level of batch shape ``[]``, or ``[n]`` for a sequence of n drawings.

        Raises:
            ValueError: As :meth:`Level.from_text`.

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
        drawings = [text] if isinstance(text, str) else list(text)
        plain, directions = zip(*map(_split, drawings), strict=True) if drawings else ((), ())
        level = Level.from_text(plain[0] if isinstance(text, str) else plain)
        return directed(level, torch.tensor(directions).reshape(level.batch_size))

    def to_text(self) -> Any:
        """Draws the levels with one character per cell; the inverse of :meth:`from_text`."""
        if self.batch_dims:
            return [level.to_text() for level in self.unbind(0)]
        return super().to_text().replace(START, AGENTS[int(self.direction)])


def directed(level: Level, direction: Tensor) -> ViewLevel:
    """Levels [*B] with the directions in which their agents begin, int64 [*B]."""
    return ViewLevel(
        walls=level.walls,
        start=level.start,
        goal=level.goal,
        direction=direction,
        batch_size=level.batch_size,
    )


def _split(drawing: str) -> tuple[str, int]:
    """A drawing whose start is an ``S``, and the direction that stood there."""
    marks = [mark for mark in drawing if mark in AGENTS]
    for mark in AGENTS:
        drawing = drawing.replace(mark, START)
    return drawing, AGENTS.index(marks[0]) if marks else 0
