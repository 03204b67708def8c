"""Named levels as text and JSON, and those of a run's record (formats: docs/how_to/levels.md)."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from proposer_rl.runs.folder import read_bounded, write_atomically
from proposer_rl.settings import arguments, settings
from proposer_rl.tasks.mazes import Level, shortest_path_length
from proposer_rl.tasks.mazes.rendering import recorded_drawing

SUFFIXES = (".txt", ".json")
RECORD = ".jsonl"  # of levels that a run trained on; read, not written
LARGEST_FILE_BYTES = 10**7  # bytes; files may come from anybody
LONGEST_NAME = 80

_HERE = Path(__file__).parent
_HEADER = re.compile(r"\[(.*)\]")
_RECORD = re.compile(r"path_length *[:=] *(\d{1,9})")


@settings
class Item:
    """A level in JSON: its name, the rows of its drawing, and the moves of its shortest path."""

    name: str
    level: list[str]
    path_length: int | None = None


def _items(levels: list[Item]) -> None:
    """Takes what a file in JSON must hold, for the check of its types."""


def read_levels(path: str | os.PathLike[str], kind: type[Level] = Level) -> dict[str, Level]:
    """Reads a file of levels.

    Args:
        path: A file whose name ends in ``.txt`` or ``.json``, or a run's ``curriculum.jsonl``.
        kind: Class of the levels, whose ``from_text`` reads their drawings.

    Returns:
        Levels of batch shape ``[]`` by their names, in the file's order.

    Raises:
        ValueError: If the file holds something else; the message names the file and the level.
        StorageError: If it cannot be read.
    """
    path = Path(path)
    check_suffix(path, (*SUFFIXES, RECORD))
    content = read_bounded(path, LARGEST_FILE_BYTES)
    try:
        text = content.decode("utf-8-sig")  # some editors begin a file with a mark
        if path.suffix == ".json":
            return levels_from_json(text, kind)
        if path.suffix == RECORD:
            return levels_from_record(text, kind)
        return levels_from_text(text, path.stem, kind)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write_levels(path: str | os.PathLike[str], levels: Mapping[str, Level]) -> None:
    """Writes a file of levels; one that exists is replaced.

    Args:
        path: As in :func:`read_levels`.
        levels: Levels of batch shape ``[]`` by their names.

    Raises:
        ValueError: If the name of the file or of a level cannot be used, or a goal is out of reach.
        StorageError: If the disk cannot take it.
    """
    path = Path(path)
    check_suffix(path, SUFFIXES)
    text = levels_to_json(levels) if path.suffix == ".json" else levels_to_text(levels)
    write_atomically(path, text.encode())


def shipped_sets() -> list[str]:
    """Returns the names of the sets that come with the package."""
    return sorted(file.stem for file in _HERE.glob("*.txt"))


def shipped_levels(name: str, kind: type[Level] = Level) -> dict[str, Level]:
    """Returns the levels of a shipped set; an agent that turns looks to the right.

    Args:
        name: Of the set.
        kind: Class of the levels.

    Raises:
        ValueError: If there is no such set.
    """
    if name not in shipped_sets():
        raise ValueError(f"{name}: no such set of levels; available: {shipped_sets()}")
    return read_levels(_HERE / f"{name}.txt", kind)


def levels_from_text(
    text: str, unnamed: str = "level", kind: type[Level] = Level
) -> dict[str, Level]:
    """Reads levels drawn with one character per cell.

    Args:
        text: For each level a line ``[name]``, perhaps a line ``path_length: 12``, and the rows of
            its drawing as :meth:`Level.from_text` reads them. Blank lines, and lines that begin
            with a semicolon, are ignored.
        unnamed: Name of a level drawn before the first name.
        kind: As in :func:`read_levels`.

    Raises:
        ValueError: If a line or level is not like that, a name occurs twice, there is no level, or
            a path length is not that of the level.
    """
    drawn: list[tuple[str, list[str], int | None]] = []
    for line in map(str.strip, text.splitlines()):
        header, record = _HEADER.fullmatch(line), _RECORD.fullmatch(line)
        if not line or line.startswith(";"):
            continue
        if header or not drawn:
            drawn.append((header[1].strip() if header else unnamed, [], None))
        name, rows, _ = drawn[-1]
        if record:
            drawn[-1] = (name, rows, int(record[1]))
        elif not header:
            rows.append(line)
    return named_levels(drawn, kind)


def levels_from_json(text: str, kind: type[Level] = Level) -> dict[str, Level]:
    """Reads levels from JSON.

    Args:
        text: ``{"levels": [{"name": "hall", "level": ["S..", "..G"], "path_length": 3}]}``; the
            path length may be missing.
        kind: As in :func:`read_levels`.

    Raises:
        ValueError: As :func:`levels_from_text`.
    """
    content = json.loads(text)
    if not isinstance(content, dict) or "levels" not in content:
        raise ValueError('must be an object with a list "levels"')
    items: list[Item] = arguments(_items, {"levels": content["levels"]})["levels"]
    return named_levels([(item.name, item.level, item.path_length) for item in items], kind)


def levels_from_record(text: str, kind: type[Level] = Level) -> dict[str, Level]:
    """Reads the levels of a run's ``curriculum.jsonl``, those too whose goal is out of reach.

    Args:
        text: One JSON object per line: ``updates``, ``seed`` and ``levels``, each of which has its
            drawing as ``text``, with the Solver's episode in it. A last line without its newline
            was interrupted, and is left out.
        kind: As in :func:`read_levels`.

    Returns:
        Levels by updates and place in the batch, as ``update_00010_1``, of several seeds by these,
        too, as ``seed_0_update_00010_1``.

    Raises:
        ValueError: If a line is not like that, or there is no level.
    """
    levels: dict[tuple[int, str], Level] = {}
    for number, line in enumerate(text.split("\n")[:-1], 1):
        try:
            row = json.loads(line)
            seed, updates = int(row["seed"]), int(row["updates"])
            for nth, level in enumerate(row["levels"], 1):
                drawing = "\n".join(recorded_drawing(level))
                levels[seed, f"update_{updates:05}_{nth}"] = kind.from_text(drawing)
        except (LookupError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"line {number} is no record of mazes") from error
    if not levels:
        raise ValueError("holds no levels")
    several = len({seed for seed, _ in levels}) > 1
    return {f"seed_{seed}_{name}" if several else name: v for (seed, name), v in levels.items()}


def levels_to_text(levels: Mapping[str, Level]) -> str:
    """Draws levels; the inverse of :func:`levels_from_text`, with their path lengths."""
    return "\n".join(
        f"[{name}]\npath_length: {length}\n{level.to_text()}\n"
        for name, level, length in _with_lengths(levels)
    )


def levels_to_json(levels: Mapping[str, Level]) -> str:
    """Writes levels as JSON; the inverse of :func:`levels_from_json`, with their path lengths."""
    items = [
        {"name": name, "path_length": length, "level": level.to_text().splitlines()}
        for name, level, length in _with_lengths(levels)
    ]
    return json.dumps({"levels": items}, indent=1) + "\n"


def named_levels(
    drawn: Sequence[tuple[str, Sequence[str], int | None]], kind: type[Level] = Level
) -> dict[str, Level]:
    """Returns levels by name, of their names, rows and, where known, shortest path lengths.

    Raises:
        ValueError: As :func:`levels_from_text`.
    """
    levels: dict[str, Level] = {}
    for name, rows, recorded in drawn:
        if name in levels:
            raise ValueError(f"level {name!r:.80}: the name occurs twice")
        try:
            levels[name] = kind.from_text("\n".join(rows))
        except ValueError as error:
            reason = str(error).partition(", got")[0]
            raise ValueError(f"level {name!r:.80}: {reason}") from error
        _check_length(name, levels[name], recorded)
    if not levels:
        raise ValueError("holds no levels")
    return levels


def _with_lengths(levels: Mapping[str, Level]) -> list[tuple[str, Level, int]]:
    return [(name, level, _check_length(name, level)) for name, level in levels.items()]


def _check_length(name: str, level: Level, recorded: int | None = None) -> int:
    """Returns the length of a level's shortest path; refuses another recorded one."""
    usable = name.strip() == name and name.isprintable() and not set(name) & set("[]")
    if not usable or not 0 < len(name) <= LONGEST_NAME:
        raise ValueError(
            f"level {name!r:.80}: a name has 1 to {LONGEST_NAME} printable characters, no brackets"
        )
    length = int(shortest_path_length(level))
    if length < 0:
        raise ValueError(f"level {name!r}: the goal cannot be reached")
    if recorded not in (None, length):
        raise ValueError(
            f"level {name!r}: path_length is {recorded}, but the shortest path has {length} moves"
        )
    return length


def check_suffix(path: Path, known: Sequence[str]) -> None:
    """Refuses a file whose name says that it holds something else."""
    if path.suffix not in known:
        raise ValueError(f"{path}: must end in one of {', '.join(known)}")
