"""Levels in which an agent looks in a direction, and the files that users have of them."""

from __future__ import annotations

import ast
import io
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from proposer_rl.runs.folder import read_bounded
from proposer_rl.tasks.mazes import level_files
from proposer_rl.tasks.mazes.levels import FREE, GOAL, START, WALL, Level, drawn_rows

AGENTS = (">", "v", "<", "^")
"""The agent in a drawing, by its direction: 0 right, 1 down, 2 left, 3 up."""

AHEAD = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Change of row and column on moving forward, by direction."""

VIEW_SUFFIXES = (".txt", ".json", level_files.RECORD, ".py", ".npy")
EMPTY_OBJECT, WALL_OBJECT, FLOOR_OBJECT, GOAL_OBJECT, AGENT_OBJECT = 1, 2, 3, 8, 10
"""Objects by MiniGrid's numbers."""

OBJECT_MARKS = {EMPTY_OBJECT: FREE, FLOOR_OBJECT: FREE, WALL_OBJECT: WALL, GOAL_OBJECT: GOAL}


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
    """Returns levels [*B] with the directions in which their agents begin, int64 [*B]."""
    return ViewLevel(
        walls=level.walls,
        start=level.start,
        goal=level.goal,
        direction=direction,
        batch_size=level.batch_size,
    )


def read_view_levels(path: str | os.PathLike[str]) -> dict[str, ViewLevel]:
    """Reads a file of levels; nothing in it is executed.

    - ``.txt``, ``.json`` and a run's ``curriculum.jsonl``: as
      :func:`~proposer_rl.tasks.mazes.level_files.read_levels`; the start is one of ``>``, ``v``,
      ``<``
      and ``^``, or an ``S`` that looks to the right. A single drawing of jaxued's is such a file.
    - ``.py``: a module such as jaxued's ``environments/maze/level.py``: every text in it that is
      assigned to a name and drawn like that is a level of this name.
    - ``.npy``, or a list in ``.json``: MiniGrid's encoding of one grid, [W, H, 3], or of several of
      one size, [n, W, H, 3], with the agent in it, as ``FullyObsWrapper`` has it. A border of walls
      is left out.

    Returns:
        Levels of batch shape ``[]`` by their names, in the file's order.

    Raises:
        ValueError: If the file holds something else; the message names the file.
        StorageError: If it cannot be read.
    """
    path = Path(path)
    level_files.check_suffix(path, VIEW_SUFFIXES)
    content = read_bounded(path, level_files.LARGEST_FILE_BYTES)
    a_list = path.suffix == ".json" and content.lstrip().startswith(b"[")
    encoded = a_list or path.suffix == ".npy"
    if not encoded and path.suffix != ".py":
        return cast(dict[str, ViewLevel], level_files.read_levels(path, ViewLevel))
    try:
        drawn = _encoded(content, path) if encoded else _assigned(content)
        named = [(name, rows, None) for name, rows in drawn.items()]
        return cast(dict[str, ViewLevel], level_files.named_levels(named, ViewLevel))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _assigned(content: bytes) -> dict[str, list[str]]:
    """Reads the drawings that a module assigns to names, as rows."""
    try:
        body = ast.parse(content).body
    except SyntaxError:
        raise ValueError("is no Python module") from None
    return {
        target.id: drawn_rows(statement.value.value)
        for statement in body
        if isinstance(statement, ast.Assign | ast.AnnAssign)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
        and _is_drawing(statement.value.value)
        for target in getattr(statement, "targets", [getattr(statement, "target", None)])
        if isinstance(target, ast.Name)
    }


def _is_drawing(text: str) -> bool:
    marks = set("".join(text.split()))
    return (
        GOAL in marks and bool(marks & set(AGENTS)) and marks <= {*AGENTS, *OBJECT_MARKS.values()}
    )


def _encoded(content: bytes, path: Path) -> Mapping[str, list[str]]:
    """Reads MiniGrid's encodings, as rows of drawings."""
    if path.suffix == ".npy":
        array: NDArray[Any] = np.load(io.BytesIO(content), allow_pickle=False)
    else:
        array = np.array(json.loads(content))
    if array.ndim not in (3, 4) or array.shape[-1] != 3 or array.dtype.kind not in "iu":
        raise ValueError(
            "must be MiniGrid's encoding of grids, whole numbers [W, H, 3] or [n, W, H, 3], got "
            f"{array.dtype} {list(array.shape)}"
        )
    if array.ndim == 3:
        return {path.stem: list(_drawn(array, path.stem))}
    names = [f"{path.stem}_{number}" for number in range(len(array))]
    return {name: list(_drawn(grid, name)) for name, grid in zip(names, array, strict=True)}


def _drawn(grid: NDArray[Any], name: str) -> Iterator[str]:
    """Yields the rows of a drawing of one grid [W, H, 3] of objects, colours and states."""
    objects, states = grid[..., 0].T, grid[..., 2].T  # [H, W]
    border = [objects[0], objects[-1], objects[:, 0], objects[:, -1]]
    if min(objects.shape) > 2 and all((side == WALL_OBJECT).all() for side in border):
        objects, states = objects[1:-1, 1:-1], states[1:-1, 1:-1]
    if (objects == AGENT_OBJECT).sum() != 1:
        raise ValueError(
            f"level {name!r}: must have one agent (object {AGENT_OBJECT}), as "
            "FullyObsWrapper shows it"
        )
    for row, state in zip(objects.tolist(), states.tolist(), strict=True):
        marks = []
        for number, direction in zip(row, state, strict=True):
            if number == AGENT_OBJECT and 0 <= direction < len(AGENTS):
                marks.append(AGENTS[direction])
            elif number in OBJECT_MARKS:
                marks.append(OBJECT_MARKS[number])
            else:
                raise ValueError(
                    f"level {name!r}: object {number} with state {direction} is none of this maze's"
                )
        yield "".join(marks)
