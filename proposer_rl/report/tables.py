"""Holds tables and writes them as CSV and Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from proposer_rl.report.statistics import Interval

Cell = str | int | float | Interval | None


@dataclass(frozen=True)
class Table:
    """Rows with the same columns.

    Attributes:
        name: of its files.
        title: above it.
        note: explains it.
        rows: mappings from a column's title to the cell, which is None if empty.
        aside: titles of the columns that only the CSV has.
    """

    name: str
    title: str
    note: str
    rows: Sequence[Mapping[str, Cell]]
    aside: Sequence[str] = ()

    @property
    def columns(self) -> list[str]:
        """Titles of the columns that a reader sees."""
        return [name for name in self._all if name not in self.aside]

    @property
    def _all(self) -> list[str]:
        return list(self.rows[0]) if self.rows else []

    def texts(self) -> list[list[str]]:
        """Returns the cells as text for a reader, [rows][columns]."""
        return [[write(row[name]) for name in self.columns] for row in self.rows]

    def to_markdown(self) -> str:
        """Returns the table in GitHub's Markdown."""
        lines = [self.columns, ["---"] * len(self.columns), *self.texts()]
        return "".join(f"| {' | '.join(map(escape_markdown, line))} |\n" for line in lines)

    def to_csv(self) -> str:
        """Returns the cells' numbers as CSV; an interval takes three columns."""
        columns: dict[str, list[Any]] = {}
        for name in self._all:
            cells = [row[name] for row in self.rows]
            columns[name] = [c.estimate if isinstance(c, Interval) else c for c in cells]
            if any(isinstance(cell, Interval) for cell in cells):
                for end in ("low", "high"):
                    columns[f"{name}, {end}"] = [getattr(cell, end, None) for cell in cells]
        return str(pd.DataFrame(columns).to_csv(index=False, float_format="%.6g"))


def write(cell: Cell, digits: int | None = None) -> str:
    """Returns a cell as text, with as many digits as suit its size unless given."""
    if isinstance(cell, Interval):
        if digits is None:
            digits = 1 if max(map(abs, cell)) >= 2 else 3
        estimate, low, high = (write(value, digits) for value in cell)
        alone = math.isnan(cell.low) or cell.low == cell.high  # too few seeds, or all alike
        return estimate if alone else f"{estimate} [{low}, {high}]"
    if cell is None or cell == "" or cell != cell:
        return "–"
    if isinstance(cell, str):
        return cell
    if digits is None:
        digits = 0 if isinstance(cell, int) else 1 if abs(cell) >= 2 else 3
        if 0 < abs(cell) < 0.5 * 10**-digits:
            return f"{cell:.2g}".replace("-", "−")
    text = f"{cell:,.{digits}f}"
    return text.replace("-", "−") if float(text.replace(",", "")) else text.lstrip("-")


def escape_markdown(text: str) -> str:
    """Escapes a text for Markdown, on one line."""
    for character in "\\|<>`*_[]":
        text = text.replace(character, f"\\{character}")
    return " ".join(text.split())
