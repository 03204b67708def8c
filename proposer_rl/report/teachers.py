"""A page of the logs of teachers in loops of one's own, as ``Teacher.log(file)`` writes them."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import FigureBase

from proposer_rl.report.build import check_output
from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.runs import LARGEST_FILE
from proposer_rl.report.style import Drawing, Look, finish, looks, render, style
from proposer_rl.runs.folder import read_jsonl, write_atomically
from proposer_rl.runs.records import LARGEST, Column, batch_shares, printable

PAGE = "teachers.html"
COMMON = ("mean_return", "mean_success", "proposed", "told", "dropped", "out")
MOST_PANELS = 24  # of entries, and of parameters
MOST_TICKS = 16
X = "levels told"

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Logs of teachers</title>
<style>body{font:16px/1.5 sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem}
img{max-width:100%}</style></head><body>
<h1>Logs of teachers</h1>
{% for drawing, content in figures %}
<h2>{{ drawing.title }}</h2>
<img alt="{{ drawing.title }}" src="data:image/png;base64,{{ content }}">
<p>{{ drawing.caption }}</p>
{% endfor %}
</body></html>
"""


class Log(NamedTuple):
    """A teacher's log: its entries over the number of levels that had been told.

    Attributes:
        x: levels told, float [m].
        entries: numbers by name, NaN where there is none; means over students or bins, float [m].
        drawn: by parameter, the names of its bins and the shares of the levels, float [m, n].
    """

    x: Column
    entries: dict[str, Column]
    drawn: dict[str, tuple[list[str], Column]]


def write_teachers(files: Sequence[Path], output: Path) -> Path:
    """Writes a page of some logs into a folder, and returns its path.

    Raises:
        UnreadableRun: for a file that is no such log.
        OutputError: if the folder has files of somebody else.
    """
    logs = {}
    for file in files:
        name = printable(file.stem)[:80]
        # What tells two paths from each other stands rather at their ends.
        logs[name if name not in logs else printable(str(file))[-80:]] = read_log(file)
    check_output(output, PAGE, "report.html")
    output.mkdir(parents=True, exist_ok=True)
    figures = [
        (drawing, base64.b64encode(*render(drawing, "png")).decode()) for drawing in drawings(logs)
    ]
    template = Environment(autoescape=True, undefined=StrictUndefined).from_string(TEMPLATE)
    write_atomically(output / PAGE, template.render(figures=figures).encode())
    return output / PAGE


def read_log(file: Path) -> Log:
    """Reads a log from a file, which is not trusted.

    Raises:
        UnreadableRun: naming the file.
    """
    try:
        if file.stat().st_size > LARGEST_FILE:
            raise ValueError(f"is larger than {LARGEST_FILE:,} bytes")
        rows: Sequence[dict[str, Any]] = read_jsonl(file)
        if not rows or not all("told" in row and "drawn" in row for row in rows):
            raise ValueError("is no log of a teacher, as teacher.log(file) writes it")
        rows = [row | {f"share: {n}": s for n, s in batch_shares(row).items()} for row in rows]
        names = dict.fromkeys([*COMMON, *(name for row in rows for name in row)])
        entries = {
            name: np.array([_mean(row.get(name)) for row in rows])
            for name in names
            if name not in ("drawn", "histogram")  # the curriculum's own count of the former
        }
        drawn = {}
        for name in rows[0]["drawn"]:
            bins = list(rows[0]["drawn"][name])
            counts = np.array([[float(row["drawn"][name][one]) for one in bins] for row in rows])
            drawn[name] = bins, counts / counts.sum(1, keepdims=True).clip(1)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UnreadableRun(f"{file}: {printable(str(error))[:300]}") from error
    known = {name: values for name, values in entries.items() if np.isfinite(values).any()}
    return Log(np.nan_to_num(entries["told"]).cumsum(), known, drawn)


def drawings(logs: Mapping[str, Log]) -> list[Drawing]:
    """Returns figures: the entries of all logs side by side, and the levels of each."""
    named = looks(logs)
    names = dict.fromkeys(name for log in logs.values() for name in log.entries)
    panels = [partial(_draw_entry, logs=logs, name=name, named=named) for name in names]
    found = [
        Drawing(
            "entries",
            "What came of the levels, and what the curricula tell",
            "A point for each line of a log: what happened since the line before it. Of entries of "
            f"several students or bins the mean. The first {MOST_PANELS} entries.",
            panels[:MOST_PANELS],
            3,
            named,
        )
    ]
    for label, log in logs.items():
        maps = [partial(_draw_map, log=log, name=name) for name in log.drawn]
        if maps:
            found.append(
                Drawing(
                    "drawn",
                    f"Levels that were proposed: {label}",
                    "Shares of the bins of each parameter, line by line; the darker, the more.",
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


def _mean(value: Any) -> float:
    """Returns a number, or the mean of nested ones; NaN of anything else."""
    if isinstance(value, list):
        known = [one for one in map(_mean, value) if not math.isnan(one)]
        return sum(known) / len(known) if known else math.nan
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if plain and abs(value) < LARGEST else math.nan
