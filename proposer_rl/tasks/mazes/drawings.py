"""Draws mazes as pictures and records, and reads and writes their files (docs/how_to/levels.md)."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning import in_first_episode
from proposer_rl.runs.folder import storage
from proposer_rl.runs.records import SampleRecord, checked, png
from proposer_rl.settings import within
from proposer_rl.tasks.mazes.levels import FREE, Level, shortest_path_length

SUFFIXES = (".txt", ".jsonl")  # the last is a run's record of its training
SETS = {file.stem: file for file in sorted(Path(__file__).parent.glob("*.txt"))}
"""Files of the sets of levels that come with the package, by name."""

_HEADER = re.compile(r"\[(.*)\]")
_RECORD = re.compile(r"path_length *[:=] *(-?\d{1,9})")

EPISODE = "•"  # a free cell on the path of the Solver's episode

# Okabe and Ito's palette, whose colours are distinct with common forms of colour blindness.
WALL_COLOUR = (45, 45, 45)
FREE_COLOUR = (250, 250, 250)
LINE_COLOUR = (215, 215, 215)
START_COLOUR = (0, 114, 178)  # blue
GOAL_COLOUR = (230, 159, 0)  # orange
PATH_COLOUR = (204, 121, 167)  # reddish purple
AGENT_COLOUR = (0, 158, 115)  # bluish green
DIRECTION_COLOUR = (255, 255, 255)

Cells = Sequence[Sequence[int]] | Tensor


def draw_level(
    level: Level, path: Cells | None = None, agent: Sequence[int] | None = None, cell: int = 16
) -> Tensor:
    """Draws one level.

    Args:
        level: A level of batch shape ``[]``. If it has a ``direction`` (0 right, 1 down, 2 left,
            3 up), a white triangle in the start's cell shows it.
        path: Cells (row, column) to connect by a line, ``[T, 2]``, each equal to the one before
            or beside it.
        agent: Row and column of an agent, drawn as a disc.
        cell: Side of a cell, at least 4 pixels.

    Returns:
        uint8 ``[H * cell + 1, W * cell + 1, 3]`` on the CPU, with lines one pixel wide between
        cells.
    """
    walls = level.walls.cpu()
    height, width = walls.shape
    colours = torch.tensor([FREE_COLOUR, WALL_COLOUR], dtype=torch.uint8)[walls.long()]
    colours[tuple(level.start.tolist())] = torch.tensor(START_COLOUR, dtype=torch.uint8)
    colours[tuple(level.goal.tolist())] = torch.tensor(GOAL_COLOUR, dtype=torch.uint8)
    picture = torch.empty(height * cell + 1, width * cell + 1, 3, dtype=torch.uint8)
    picture[:-1, :-1] = colours.repeat_interleave(cell, 0).repeat_interleave(cell, 1)
    picture[::cell] = picture[:, ::cell] = torch.tensor(LINE_COLOUR, dtype=torch.uint8)
    if path is not None:
        centre = torch.as_tensor(path).cpu() * cell + cell // 2  # [T, 2]
        half = max(cell // 10, 1)
        for here, there in zip(centre, torch.cat([centre[1:], centre[-1:]]), strict=True):
            top, left = (torch.minimum(here, there) - half).tolist()
            bottom, right = (torch.maximum(here, there) + half + 1).tolist()
            picture[top:bottom, left:right] = torch.tensor(PATH_COLOUR, dtype=torch.uint8)
    offset = torch.arange(cell) - cell // 2
    if hasattr(level, "direction"):
        tip = (0.35 * cell - offset) / 2  # half of the triangle's height, by column
        to_the_right = (offset.abs().unsqueeze(1) <= tip) & (offset >= -0.25 * cell)
        triangle = to_the_right.rot90(-int(level.direction))
        _paint(picture, level.start.tolist(), triangle, DIRECTION_COLOUR)
    if agent is not None:
        round_one = offset.square().unsqueeze(1) + offset.square() <= (0.3 * cell) ** 2
        _paint(picture, agent, round_one, AGENT_COLOUR)
    return picture


def level_records(levels: Level, rollout: TensorDictBase | None) -> Iterator[dict[str, Any]]:
    """Yields records of levels [n], pictures and texts, with a Solver's first episodes [n, T]."""
    levels = levels.cpu()
    for i, text in enumerate(levels.to_text()):
        path = None if rollout is None else _first_path(rollout[i])
        lines = [list(line) for line in text.splitlines()]
        for row, column in path or []:
            if lines[row][column] == FREE:
                lines[row][column] = EPISODE
        yield {
            "picture": png(draw_level(levels[i], path).numpy()),
            "text": [" ".join(line) for line in lines],
            **({} if path is None else {"path": path}),
        }


def recorded_drawing(text: Sequence[str]) -> list[str]:
    """Returns the rows of a level's drawing from its record, without the Solver's path."""
    return [line.replace(" ", "").replace(EPISODE, FREE) for line in text]


def _first_path(steps: TensorDictBase) -> list[list[int]]:
    """Returns the agent's cells (row, column) from start to end of its first episode in [T]."""
    first = in_first_episode(steps)
    return steps["agent"][:1].tolist() + steps["next", "agent"][first].tolist()


def _paint(
    picture: Tensor, place: Sequence[int], shape: Tensor, colour: tuple[int, int, int]
) -> None:
    """Paints the pixels of a bool ``[cell, cell]`` in the cell at a row and column."""
    cell = len(shape)
    top, left = (int(number) * cell for number in place)
    square = picture[top : top + cell, left : left + cell]
    square[shape] = torch.tensor(colour, dtype=torch.uint8)


@dataclass
class Item:
    """A level's name, the rows of its drawing, and the moves of its shortest path."""

    name: str
    level: list[str]
    path_length: int | None = None


def read_levels(path: str | os.PathLike[str], kind: type[Level] = Level) -> dict[str, Level]:
    """Reads a file of levels.

    A file in JSON is ``{"levels": [{"name": "hall", "level": ["S..", "..G"], "path_length": 3}]}``;
    the path length may be missing. A run's ``curriculum.jsonl`` has an object in each line:
    ``updates``, ``seed`` and ``levels``, each with its drawing as ``text``; a last line without its
    newline was interrupted, and is left out. Its levels are named by updates and place in the
    batch, such as ``update_00010_1``, or ``seed_0_update_00010_1`` if there are several seeds.

    Args:
        path: A file whose name ends in ``.txt`` (see :func:`levels_from_text`) or ``.jsonl``.
        kind: Class of the levels, whose ``from_text`` reads their drawings.

    Returns:
        Levels of batch shape ``[]`` by their names, in the file's order.

    Raises:
        ValueError: If the file has another content; the message names the file and the level.
        StorageError: If it cannot be read.
    """
    path = Path(path)
    with storage(path, "read"):
        content = path.read_bytes()
    try:
        text = content.decode("utf-8-sig")  # some editors begin a file with a mark
        if path.suffix == ".jsonl":
            return _levels(_recorded(text), kind)
        return levels_from_text(text, path.stem, kind)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def levels_from_text(
    text: str, unnamed: str = "level", kind: type[Level] = Level
) -> dict[str, Level]:
    """Reads levels drawn with one character per cell.

    Args:
        text: For each level a line ``[name]``, perhaps a line ``path_length: 12``, and the rows of
            its drawing as in :meth:`Level.from_text`. Blank lines, and lines that begin with a
            semicolon, are ignored.
        unnamed: Name of a level drawn before the first name.
        kind: As in :func:`read_levels`.

    Raises:
        ValueError: If a drawing is not a level, a name occurs twice, there is no level, or a path
            length is not that of the level.
    """
    drawn: list[Item] = []
    for line in map(str.strip, text.splitlines()):
        header, record = _HEADER.fullmatch(line), _RECORD.fullmatch(line)
        if not line or line.startswith(";"):
            continue
        if header or not drawn:
            drawn.append(Item(header[1].strip() if header else unnamed, []))
        if record:
            drawn[-1].path_length = int(record[1])
        elif not header:
            drawn[-1].level.append(line)
    return _levels(drawn, kind)


def _recorded(text: str) -> list[Item]:
    """Reads the levels of a run's ``curriculum.jsonl``; see :func:`read_levels`."""
    rows = checked(list[SampleRecord], [json.loads(x) for x in text.split("\n")[:-1]], "")
    several = len({row.seed for row in rows}) > 1
    return [
        Item(
            f"seed_{row.seed}_" * several + f"update_{row.updates:05}_{nth}",
            recorded_drawing(level.text),
        )
        for row in rows
        for nth, level in enumerate(row.levels, 1)
    ]


def levels_to_text(levels: Mapping[str, Level]) -> str:
    """Draws levels; the inverse of :func:`levels_from_text`, with their path lengths."""
    return "\n".join(
        f"[{name}]\npath_length: {int(shortest_path_length(level))}\n{level.to_text()}\n"
        for name, level in levels.items()
    )


def _levels(drawn: Sequence[Item], kind: type[Level]) -> dict[str, Level]:
    levels: dict[str, Level] = {}
    for item in drawn:
        where = f"level {item.name!r:.80}"
        if item.name in levels:
            raise ValueError(f"{where}: the name occurs twice")
        with within(where, ValueError):
            level = levels[item.name] = kind.from_text("\n".join(item.level))
        if item.path_length not in (None, length := int(shortest_path_length(level))):
            raise ValueError(
                f"{where}: path_length is {item.path_length}, but the shortest path has {length} "
                "moves"
            )
    if not levels:
        raise ValueError("holds no levels")
    return levels
