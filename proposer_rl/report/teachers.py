"""Reads and draws the logs that ``Teacher.log(file)`` writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import FigureBase

from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.style import Drawing, Look, finish, looks, style
from proposer_rl.runs.folder import read_jsonl
from proposer_rl.runs.records import Column, Record, flat, printable

COMMON = ("mean_return", "mean_success", "proposed", "told", "dropped", "out")
# Entries that are not curves: counts by bin, of the teacher and of its curriculum, and the teacher
# and place of the line.
ASIDE = ("drawn", "histogram", "teacher", "levels_told")
MOST_PANELS = 24  # of entries, and of parameters
MOST_TICKS = 16
X = "levels told"


class Log:
    """The lines of a log, as :meth:`proposer_rl.teaching.teacher.Teacher.log` writes them."""

    def __init__(self, rows: Sequence[Record]) -> None:
        self.rows = rows
        # The number of levels that each line's teacher had been told since it began, float [m].
        self.x = np.array([row["levels_told"] for row in rows], float)

    @cached_property
    def entries(self) -> dict[str, Column]:
        """Numbers by name, NaN where there is none, float [m].

        Of entries with several numbers these are the maximum and the mean.
        """
        own = [flat({k: v for k, v in row.items() if k not in ASIDE}) for row in self.rows]
        known = dict.fromkeys(name for row in own for name in row)
        names = [*(name for name in COMMON if name in known), *known]
        return {name: np.array([row.get(name, np.nan) for row in own]) for name in names}

    @cached_property
    def drawn(self) -> dict[str, tuple[list[str], Column]]:
        """The names of each parameter's bins, and the shares of proposed levels there, [m, n]."""
        found = {}
        for name, bins in self.rows[0]["drawn"].items():
            counts = np.array([[*row["drawn"][name].values()] for row in self.rows], float)
            found[name] = [*bins], counts / counts.sum(1, keepdims=True).clip(1)
        return found

    def curves(self) -> dict[str, Log]:
        """Splits the lines by teacher, and where a loop went on from an earlier state.

        Returns:
            By what tells them apart; a log that is one curve by the empty text.
        """
        parts: dict[tuple[Any, int], list[Record]] = {}
        last: dict[Any, tuple[int, float]] = {}
        for row in self.rows:
            part, before = last.get(row["teacher"], (1, 0.0))
            part += _start(row) < before  # the loop went on from an earlier state than its last
            last[row["teacher"]] = part, row["levels_told"]
            parts.setdefault((row["teacher"], part), []).append(row)
        found = {}
        for (whose, part), rows in parts.items():
            names = [f"teacher {whose}"] if len(last) > 1 else []
            names += [f"part {part}, from {_start(rows[0]):g} levels on"] if part > 1 else []
            found[", ".join(names)] = Log(rows)
        return found


def _start(row: Record) -> float:
    """Returns how many levels a teacher had been told before a line of its log."""
    return float(row["levels_told"] - row["told"])


def read_log(file: Path) -> Log:
    """Reads a log from a file.

    Raises:
        UnreadableRun: naming the file.
    """
    try:
        rows: Sequence[dict[str, Any]] = read_jsonl(file)
    except (OSError, ValueError) as error:
        raise UnreadableRun(f"{file}: {printable(str(error))}") from error
    if not rows or not all(
        {"teacher", "levels_told", "told", "drawn"} <= row.keys() for row in rows
    ):
        raise UnreadableRun(f"{file}: is not a log that teacher.log(file) has written")
    return Log(rows)


def read_curves(files: Sequence[Path]) -> tuple[dict[str, Log], list[str]]:
    """Reads logs and splits them by teacher.

    Returns:
        The logs by their labels, and notes on files that are more than one curve.

    Raises:
        UnreadableRun: for a file that is not such a log.
    """
    logs: dict[str, Log] = {}
    notes = []
    for file in files:
        stems = [other.stem for other in files]
        label = file.stem if stems.count(file.stem) == 1 else str(file)
        found = read_log(file).curves()
        logs |= {", ".join(filter(None, [label, name])): log for name, log in found.items()}
        if len(found) > 1:
            notes.append(
                f"{label} has {len(found)} curves, since several teachers have written to it, or a "
                "loop has gone on from an earlier state."
            )
    return logs, notes


def drawings(logs: Mapping[str, Log]) -> list[Drawing]:
    """Draws the entries of all logs side by side, and the levels of each log."""
    named = looks(logs)
    names = dict.fromkeys(name for log in logs.values() for name in log.entries)
    panels = [partial(_draw_entry, logs=logs, name=name, named=named) for name in names]
    found = [
        Drawing(
            "teachers",
            "What came of the levels, and what the curricula tell",
            "Each line of a log is a point and tells what happened since the line before. Of "
            "entries of several numbers the maximum and the mean are drawn. Only the first "
            f"{MOST_PANELS} are drawn.",
            panels[:MOST_PANELS],
            3,
            named,
        )
    ]
    for number, (label, log) in enumerate(logs.items(), 1):
        maps = [partial(_draw_map, log=log, name=name) for name in log.drawn]
        if maps:
            found.append(
                Drawing(
                    f"teachers_levels_{number}",
                    f"Levels that were proposed: {label}",
                    "Shares of each parameter's bins, line by line; darker is more.",
                    maps[:MOST_PANELS],
                    3,
                )
            )
    return found


def _draw_entry(
    figure: FigureBase, logs: Mapping[str, Log], name: str, named: Mapping[str, Look]
) -> None:
    axes, shown = figure.subplots(), []
    for label, log in logs.items():
        if name in log.entries:
            values = log.entries[name]
            axes.plot(log.x, values, **style(named[label], len(values)))
            shown.append(values)
    finish(axes, X, printable(name)[:40], shown, rate=name == "mean_success")


def _draw_map(figure: FigureBase, log: Log, name: str) -> None:
    axes = figure.subplots()
    bins, shares = log.drawn[name]
    axes.imshow(shares.T, aspect="auto", origin="lower", cmap="Blues", interpolation="nearest")
    every = -(-len(bins) // MOST_TICKS)
    places = range(0, len(bins), every)
    axes.set_yticks(places, [printable(bins[place])[:24] for place in places], fontsize=7)
    axes.set(xlabel="line of the log", ylabel=printable(name)[:40])
    axes.grid(visible=False)
