"""A run's folder: tables that grow row by row and that a resumed run cuts back to its checkpoint.

Two kinds of table lie in the folder, told apart by their suffix. ``.csv`` is tidy: a header, then
rows of numbers and text. ``.jsonl`` holds one JSON object per line, for rows with lists in them. In
both, one row is one line, and every float is written so that it reads back bit for bit. A line
without its newline is a row that a crash interrupted: readers skip it, and
:meth:`RunFolder.cut_back` removes it.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

Number = int | float

_PLAIN_NAME = re.compile(r"[^\s\",][^\r\n\",]*")


class StorageError(OSError):
    """The disk did not take or give a file; the message is one line that names it."""

    exit_code = 4


class RunFolder:
    """The folder of one run; created, with its parents, if it does not exist.

    Args:
        path: the folder.

    Raises:
        StorageError: if it cannot be created.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with storage(self.path):
            self.path.mkdir(parents=True, exist_ok=True)

    def append(self, name: str, row: Mapping[str, object]) -> None:
        """Adds a row to a table and waits until it is on the disk: a crash loses at most this row.

        Args:
            name: the table's file name, ending in ``.csv`` or ``.jsonl``.
            row: for ``.csv`` numbers, with the same keys in every row of the table (the
                first row makes the header); for ``.jsonl`` whatever JSON can hold.

        Raises:
            ValueError: if the name is not a table's, a value cannot be written, the keys are not
                those of the header, or the table ends in the middle of a row.
            StorageError: if the disk does not take the row.
        """
        path = self._table(name)
        with storage(path):
            size = path.stat().st_size if path.exists() else 0
            if size and not _ends_with_newline(path):
                raise ValueError(f"{path} ends in the middle of a row; cut it back first")
            lines = _new_lines(path, row, with_header=not size)
            with open(path, "ab") as file:
                file.write(lines.encode())
                file.flush()
                os.fsync(file.fileno())
            if not size:
                _sync_folder(self.path)

    def lengths(self) -> dict[str, int]:
        """Returns the number of complete rows of each table in the folder, by file name."""
        return {path.name: _count_rows(path) for path in self._tables()}

    def cut_back(self, lengths: Mapping[str, int]) -> None:
        """Removes the rows that were added after ``lengths()`` returned ``lengths``.

        Tables without rows then, or that are not named, are deleted. All is checked before anything
        is changed, and a call that was interrupted can be repeated.

        Args:
            lengths: rows to keep of each table, by file name.

        Raises:
            ValueError: if a table has fewer rows than it should keep.
            StorageError: if a table cannot be changed.
        """
        ends = {name: _end_of_row(self._table(name), rows) for name, rows in lengths.items()}
        for path in self._tables():
            end = ends.get(path.name, 0)
            with storage(path):
                if end == 0:
                    path.unlink()
                elif end < path.stat().st_size:
                    _truncate(path, end)
        _sync_folder(self.path)

    def write_json(self, name: str, value: object) -> None:
        """Writes a JSON file; whoever reads it sees the old content or the new, never a part.

        Args:
            name: the file's name.
            value: whatever JSON can hold.

        Raises:
            ValueError: if the value cannot be written as JSON.
            StorageError: if the disk does not take it.
        """
        path = self.path / name
        write_atomically(path, (_to_json(path, value, indent=2) + "\n").encode())

    def _table(self, name: str) -> Path:
        if Path(name).name != name or Path(name).suffix not in (".csv", ".jsonl"):
            raise ValueError(f"a table is a file name ending in .csv or .jsonl, not {name!r}")
        return self.path / name

    def _tables(self) -> list[Path]:
        return sorted([*self.path.glob("*.csv"), *self.path.glob("*.jsonl")])


def read_csv(path: str | os.PathLike[str]) -> list[dict[str, Number]]:
    """Reads a ``.csv`` table of a run's folder.

    Returns:
        One mapping per complete row, its values as they were given to :meth:`RunFolder.append`.

    Raises:
        FileNotFoundError: if there is no such table.
        ValueError: if a line is not a row of the table.
    """
    lines = _lines(Path(path))
    header = next(lines, (0, ""))[1].split(",")
    return [_parse_row(f"{path}, line {number}", header, line) for number, line in lines]


def read_jsonl(path: str | os.PathLike[str]) -> list[dict[str, object]]:
    """Reads a ``.jsonl`` table of a run's folder.

    Returns:
        One mapping per complete row.

    Raises:
        FileNotFoundError: if there is no such table.
        ValueError: if a line is not a JSON object.
    """
    rows = []
    for number, line in _lines(Path(path)):
        try:
            row = json.loads(line)
        except (json.JSONDecodeError, RecursionError) as error:
            raise ValueError(f"{path}, line {number}: not JSON: {error}") from None
        if not isinstance(row, dict):
            raise ValueError(f"{path}, line {number}: not a JSON object: {line[:60]}")
        rows.append(row)
    return rows


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file under a temporary name beside it, then renames it, and waits for the disk.

    A crash leaves the old file as it was, and perhaps a ``.NAME.tmp``; an error leaves only it.

    Args:
        path: the file; an existing one is replaced.
        content: what it shall hold.

    Raises:
        StorageError: if the disk cannot take it.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    with storage(path):
        try:
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            # A full disk must not stay full of an attempt.
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        _sync_folder(path.parent)


@contextmanager
def storage(path: Path, action: str = "write") -> Iterator[None]:
    """Names the file in whatever error of the operating system arises inside.

    Args:
        path: the file or folder that is worked on.
        action: what is done to it, a verb.

    Raises:
        StorageError: instead of any other OSError.
    """
    try:
        yield
    except OSError as error:
        raise StorageError(f"cannot {action} {path}: {error.strerror or error}") from error


def _new_lines(path: Path, row: Mapping[str, object], with_header: bool) -> str:
    if path.suffix == ".jsonl":
        return _to_json(path, dict(row)) + "\n"
    header = list(row) if with_header else _read_header(path)
    if set(row) != set(header):
        missing, unknown = sorted(set(header) - set(row)), sorted(set(row) - set(header))
        raise ValueError(f"{path}: a row's columns differ: missing {missing}, unknown {unknown}")
    line = ",".join(_format_cell(path, name, row[name]) for name in header) + "\n"
    return _format_header(path, header) + line if with_header else line


def _format_header(path: Path, header: list[str]) -> str:
    for name in header:
        if not _PLAIN_NAME.fullmatch(name):
            raise ValueError(f"{path}: {name!r} cannot be a column: no commas, quotes, line breaks")
    if not header:
        raise ValueError(f"{path}: a row has no columns")
    return ",".join(header) + "\n"


def _read_header(path: Path) -> list[str]:
    with open(path, "rb") as file:
        return file.readline().decode().rstrip("\n").split(",")


def _format_cell(path: Path, column: str, value: object) -> str:
    if isinstance(value, float):
        return float.__repr__(value)  # the shortest text that reads back as the same number
    if isinstance(value, int) and not isinstance(value, bool):
        return int.__repr__(value)
    raise ValueError(
        f"{path}: column {column!r} takes int or float, not {value!r} ({type(value).__name__})"
    )


def _parse_row(where: str, header: list[str], line: str) -> dict[str, Number]:
    cells = [_parse_number(where, text) for text in line.split(",")]
    if len(cells) != len(header):
        raise ValueError(f"{where}: {len(cells)} cells under {len(header)} columns")
    return dict(zip(header, cells, strict=True))


def _parse_number(where: str, text: str) -> Number:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{where}: {text!r} is not a number") from None


def _to_json(path: Path, value: object, indent: int | None = None) -> str:
    try:
        return json.dumps(value, indent=indent)
    except TypeError as error:
        raise ValueError(f"{path}: {error}") from None


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yields each complete line with its number."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no table {path}")
    with open(path, "rb") as file:
        for number, line in enumerate(file, 1):
            if line.endswith(b"\n"):
                yield number, line[:-1].decode()


def _ends_with_newline(path: Path) -> bool:
    with open(path, "rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read() == b"\n"


def _count_rows(path: Path) -> int:
    with open(path, "rb") as file:
        lines = sum(line.endswith(b"\n") for line in file)
    return max(lines - _header_lines(path), 0)


def _header_lines(path: Path) -> int:
    return 1 if path.suffix == ".csv" else 0


def _end_of_row(path: Path, rows: int) -> int:
    """Returns the size in bytes of a table of which only the first rows are kept, 0 for no rows."""
    if rows == 0:
        return 0
    found = _count_rows(path) if path.is_file() else 0
    if found < rows:
        raise ValueError(f"{path} has {found} rows, fewer than the {rows} to be kept")
    with open(path, "rb") as file:
        return sum(len(file.readline()) for _ in range(rows + _header_lines(path)))


def _truncate(path: Path, size: int) -> None:
    with open(path, "r+b") as file:
        file.truncate(size)
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    """Waits until the names in a folder are on the disk: a rename is not before that."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
