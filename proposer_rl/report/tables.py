"""Tables as data, and as CSV and Markdown."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from proposer_rl.report.statistics import Interval

# How the cells of each column are written, by its title.
Columns = Mapping[str, Callable[[Any], str]]
Cell = str | int | float | Interval | None


@dataclass(frozen=True)
class Table:
    """Rows under named columns.

    Attributes:
        name: of its files.
        title: above it.
        note: what must be known to read it.
        columns: from a column's title to how its cells are written.
        rows: cells in the order of the columns; None for an empty one.
    """

    name: str
    title: str
    note: str
    columns: Columns
    rows: Sequence[Sequence[Cell]]

    def texts(self) -> list[list[str]]:
        """The cells as a reader sees them."""
        writers = self.columns.values()
        return [
            ["–" if _empty(cell) else write(cell) for write, cell in zip(writers, row, strict=True)]
            for row in self.rows
        ]

    def to_markdown(self) -> str:
        """A table of GitHub's Markdown."""
        lines = [list(self.columns), ["---"] * len(self.columns), *self.texts()]
        return "".join(f"| {' | '.join(map(escape_markdown, line))} |\n" for line in lines)

    def to_csv(self) -> str:
        """The numbers behind the cells; an interval takes three columns."""
        spread = [any(isinstance(row[i], Interval) for row in self.rows) for i in self._indices]
        header = [
            text
            for name, wide in zip(self.columns, spread, strict=True)
            for text in ([name, f"{name}, low", f"{name}, high"] if wide else [name])
        ]
        rows = [
            [
                value
                for cell, wide in zip(row, spread, strict=True)
                for value in (_three(cell) if wide else [cell])
            ]
            for row in self.rows
        ]
        return to_csv(header, rows)

    @property
    def _indices(self) -> range:
        return range(len(self.columns))


def to_csv(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """CSV as spreadsheets and pandas read it; floats with six significant digits."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(map(_csv_cell, header))
    writer.writerows([_csv_cell(cell) for cell in row] for row in rows)
    return file.getvalue()


def number(digits: int) -> Callable[[Any], str]:
    """Write a number, or an estimate with its interval, with that many decimals."""

    def write(value: Any) -> str:
        if not isinstance(value, Interval):
            return _decimals(value, digits)
        estimate = _decimals(value.estimate, digits)
        if math.isnan(value.low):
            return estimate
        return f"{estimate} [{_decimals(value.low, digits)}, {_decimals(value.high, digits)}]"

    return write


def adaptive(value: Interval) -> str:
    """Write an estimate with its interval: rates with three decimals, counts with one."""
    return number(1 if max(map(abs, value)) >= 2 else 3)(value)


def _decimals(value: float, digits: int) -> str:
    text = f"{value:,.{digits}f}"
    return text.replace("-", "−") if float(text.replace(",", "")) else text.lstrip("-")


def _empty(cell: Cell) -> bool:
    return cell is None or cell == "" or (isinstance(cell, float) and math.isnan(cell))


def _three(cell: Cell) -> Sequence[Cell]:
    return list(cell) if isinstance(cell, Interval) else [cell, None, None]


def _csv_cell(cell: Any) -> Any:
    if isinstance(cell, float):
        return "" if math.isnan(cell) else f"{cell:.6g}"
    # A spreadsheet takes text that begins like this for a formula.
    return f"'{cell}" if isinstance(cell, str) and cell[:1] in "=+-@\t\r" and cell else cell


def escape_markdown(text: str) -> str:
    """Text that Markdown shows as it is, on one line."""
    for character in "\\|<>`*_[]":
        text = text.replace(character, f"\\{character}")
    return " ".join(text.split())
