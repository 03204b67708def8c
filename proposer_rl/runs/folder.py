"""A run's folder: tables that grow row by row and that a resumed run cuts back to its checkpoint.

There are two kinds of tables. ``.csv`` has a header and rows of numbers; ``.jsonl`` has one JSON
object per line, for rows that contain lists. In both a row is a line, and floats are written so
that they read back bit for bit. A line without its newline is a row that a crash interrupted:
readers skip it, and :meth:`RunFolder.cut_back` removes it.
"""

from __future__ import annotations

import errno
import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar

Number = int | float
T = TypeVar("T")

# The tables of a run. Other files in its folder are left alone.
TABLES = ("curriculum.jsonl", "cycles.jsonl", "levels.jsonl", "metrics.csv", "training.csv")
FAILURE = "error.json"  # the reason why a run of a sweep failed
PROPOSER = "proposer.pt"  # the trained curriculum of a run: a checkpoint without Solvers
# Tolerance for a mean that reaches a threshold: 18 of 20 in float32 is 0.89999998.
SLACK = 1e-6


class StorageError(OSError):
    """A file cannot be read or written; the message is one line that names it."""

    exit_code = 4


class RunFolder:
    """The folder of one run, created with its parents if it does not exist.

    Raises:
        StorageError: if it cannot be created.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with storage(self.path):
            self.path.mkdir(parents=True, exist_ok=True)

    def append(self, name: str, row: Mapping[str, object]) -> None:
        """Appends a row to a table and waits until it is on the disk.

        Args:
            name: the table's file name, one of :data:`TABLES`.
            row: for ``.csv`` numbers, with the same keys in every row of the table (the first row
                makes the header); for ``.jsonl`` any values that JSON can hold.

        Raises:
            ValueError: if the keys are not those of the header.
            TypeError: if a value is not a number, or JSON cannot hold it.
            StorageError: if the row cannot be written.
        """
        path = self.path / name
        with storage(path):
            first = _first_line(path)
            lines = json.dumps(dict(row)) if path.suffix == ".jsonl" else _csv(path, row, first)
            _write(path, "ab", (lines + "\n").encode())
            if first is None:
                _sync_folder(self.path)

    def lengths(self) -> dict[str, int]:
        """Returns the number of complete rows of each table in the folder, by file name."""
        return {path.name: len(_row_ends(path)) for path in self._tables()}

    def cut_back(self, lengths: Mapping[str, int]) -> None:
        """Removes the rows that were appended after :meth:`lengths` returned ``lengths``.

        Tables that had no rows then are deleted. Nothing is changed unless all tables are long
        enough, and a call that was interrupted can be repeated.

        Raises:
            ValueError: if a table has fewer rows than should be kept.
            StorageError: if a table cannot be changed.
        """
        sizes = {}
        for path in map(self.path.joinpath, TABLES):
            rows, ends = lengths.get(path.name, 0), _row_ends(path) if path.is_file() else []
            if len(ends) < rows:
                raise ValueError(f"{path} has {len(ends)} rows, fewer than the {rows} to be kept")
            sizes[path] = ends[rows - 1] if rows else 0
        for path in self._tables():
            size = sizes[path]
            with storage(path):
                if size == 0:
                    path.unlink()
                elif size < path.stat().st_size:
                    with open(path, "r+b") as file:
                        file.truncate(size)
                        os.fsync(file.fileno())
        _sync_folder(self.path)

    def write_json(self, name: str, value: object) -> None:
        """Writes a JSON file atomically; a reader sees either the old content or the new."""
        write_atomically(self.path / name, (json.dumps(value, indent=2) + "\n").encode())

    def _tables(self) -> list[Path]:
        return [path for path in map(self.path.joinpath, TABLES) if path.is_file()]


def is_rate(name: str) -> bool:
    """Returns whether a column holds rates from 0 to 1, such as success."""
    return "success" in name.split("_")


def can_reach(name: str, threshold: float) -> bool:
    """Returns whether a threshold is possible for a column; a rate's is above 0 and at most 1."""
    return not is_rate(name) or 0 < threshold <= 1


def read_csv(path: str | os.PathLike[str]) -> list[dict[str, Number]]:
    """Returns the complete rows of a ``.csv`` table, as :meth:`RunFolder.append` was given them.

    Raises:
        ValueError: naming the file and the line that is not such a row.
        FileNotFoundError: if there is no such file.
    """
    header = (_first_line(Path(path)) or "").split(",")

    def row(line: str) -> dict[str, Number]:
        return dict(zip(header, map(_number, line.split(",")), strict=True))

    return [*_parsed(Path(path), row, 1)]


def read_jsonl(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Returns the complete rows of a ``.jsonl`` table; raises as :func:`read_csv`."""
    return [*_parsed(Path(path), lambda line: dict(json.loads(line)))]


def read_table(path: Path) -> Sequence[Mapping[str, Any]]:
    """Returns the complete rows of a table of either kind."""
    return read_csv(path) if path.suffix == ".csv" else read_jsonl(path)


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file under a temporary name, renames it, and waits until it is on the disk.

    After an error the old file is as it was; a crash may also leave a ``.NAME.tmp``.

    Raises:
        StorageError: if it cannot be written.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    with storage(path):
        try:
            _write(temporary, "wb", content)
            os.replace(temporary, path)
        except BaseException:
            # On a full disk the temporary file would take the space that is left.
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        _sync_folder(path.parent)


@contextmanager
def storage(path: Path, action: str = "write") -> Iterator[None]:
    """Replaces errors of the operating system by one that names the file.

    Raises:
        StorageError: instead of any other OSError.
    """
    try:
        yield
    except OSError as error:
        raise StorageError(f"cannot {action} {path}: {error.strerror or error}") from error


def _csv(path: Path, row: Mapping[str, object], header: str | None) -> str:
    """Returns a row as text in the header's order, after a header if there is none yet."""
    columns = list(row) if header is None else header.split(",")
    if set(row) != set(columns) or any(set(name) & set(',"\r\n') for name in columns):
        raise ValueError(
            f"{path}: a row has {', '.join(row)}; the columns are {', '.join(columns)}, and their "
            "names must have no commas, quotes or line breaks"
        )
    line = ",".join(map(_text, map(row.__getitem__, columns)))
    return line if header is not None else ",".join(columns) + "\n" + line


def _text(value: Any) -> str:
    """Returns the shortest text that reads back as the same number."""
    return int.__repr__(value) if isinstance(value, int) else float.__repr__(value)


def _number(text: str) -> Number:
    return int(text) if text.removeprefix("-").isdigit() else float(text)


def _parsed(path: Path, parse: Callable[[str], T], first: int = 0) -> Iterator[T]:
    """Parses each complete line from a first one on; a ValueError names the file and line.

    Line ends of Windows, and the byte-order mark that editors there write, are removed.
    """
    with open(path, "rb") as file:
        for number, line in enumerate(file):
            if number >= first and line.endswith(b"\n"):
                try:
                    yield parse(line.decode("utf-8-sig").rstrip("\r\n"))
                except (TypeError, ValueError, RecursionError) as error:
                    raise ValueError(f"{path}, line {number + 1}: {error}") from None


def _first_line(path: Path) -> str | None:
    """Returns the first line of a table; None if there is none."""
    return next(_parsed(path, str), None) if path.exists() else None


def _row_ends(path: Path) -> list[int]:
    """Returns the byte offsets at which the complete rows of a table end."""
    with open(path, "rb") as file:
        ends = list(accumulate(len(line) for line in file if line.endswith(b"\n")))
    return ends[1:] if path.suffix == ".csv" else ends


def _write(path: Path, mode: str, content: bytes) -> None:
    """Writes to a file, and waits until it is on the disk."""
    with open(path, mode) as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Waits until the names in a folder are on the disk, as after a rename.

    Some file systems cannot do this, and Windows cannot open folders. The contents of the files are
    on the disk all the same.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES):
            raise
        warnings.warn(
            f"folders cannot be synced here ({error.strerror}): all files are written and synced, "
            "but if the machine crashes, the names of the newest may be lost",
            stacklevel=1,  # so that it is shown only once
        )
