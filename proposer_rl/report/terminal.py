"""Runs drawn in characters: one run as a screen, several as a table."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence

import numpy as np
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from proposer_rl.report.progress import Progress, duration
from proposer_rl.report.runs import Run, share_map
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import (
    GAINS,
    PLACE,
    Column,
    number,
    numbers,
    printable,
    words,
)

BLOCKS = " ▁▂▃▄▅▆▇█"
SHADES = " ░▒▓█"
COLOURS = {"finished": "green", "failed": "red", "unfinished": "yellow", "starting": "blue"}
WIDTH = 30  # characters of a curve
LEVELS = 3
NUMBERS = 8  # of a curriculum that is shown by its own
WIDEST_MAP = 20


def screen(progress: Progress) -> RenderableType:
    """One run: how far it is, its curves, its last cycle, and what it trains on."""
    head = Text.assemble((progress.state, COLOURS[progress.state]), f", {_age(progress)}")
    if progress.activity:
        head.append(f": {progress.activity}")
    if not progress.runs:
        return Panel(Group(head, Text(progress.failure)), title=_name(progress), title_align="left")
    run = progress.runs[0]
    parts: list[RenderableType] = [head, _bar(progress), _curves(progress.runs)]
    if run.cycles:
        parts += _cycles(run)
    if run.samples:
        parts.append(_levels(run))
    if progress.failure:
        parts.append(Text(progress.failure, style="red"))
    return Panel(Group(*parts), title=_name(progress), title_align="left")


def overview(found: Sequence[Progress]) -> RenderableType:
    """Several runs: one line each, and how many are in which state."""
    parent = os.path.commonpath([progress.folder.parent for progress in found])
    names = [printable(str(progress.folder.relative_to(parent))) for progress in found]
    table = Table(box=None, pad_edge=False)
    table.add_column("run", overflow="fold")
    for name, width in (("state", 10), ("updates", 7), ("last", 16), ("written", 10)):
        table.add_column(name, no_wrap=True, min_width=width)
    for name, progress in zip(names, found, strict=True):
        table.add_row(
            Text(name),
            Text(progress.state, style=COLOURS[progress.state]),
            _updates(progress),
            Text(_headline(progress)),
            _age(progress),
        )
    failures = [
        Text(f"failed: {name}: {progress.failure}", style="red")
        for name, progress in zip(names, found, strict=True)
        if progress.failure
    ]
    going = [
        Text(f"{name}: {progress.activity}")
        for name, progress in zip(names, found, strict=True)
        if progress.activity
    ]
    states = [progress.state for progress in found]
    counts = ", ".join(f"{states.count(state)} {state}" for state in COLOURS if state in states)
    return Group(table, *going, *failures, Text(f"{len(found)} runs: {counts}"))


def sparkline(values: Iterable[float], low: float, high: float) -> str:
    """Values as blocks of rising height; values outside are drawn at the edge."""
    span = (high - low) or 1.0
    steps = [(value - low) / span * (len(BLOCKS) - 1) for value in values]
    return "".join(BLOCKS[min(max(round(step), 0), len(BLOCKS) - 1)] for step in steps)


def _name(progress: Progress) -> Text:
    if not progress.runs:
        return Text(printable(progress.folder.name))
    run = progress.runs[0]
    seeds = ", ".join(str(run.seed) for run in progress.runs)
    ablation = "" if run.ablation == "none" else f", {run.ablation}"
    return Text(f"{run.method}{ablation}, seed {seeds}")


def _bar(progress: Progress) -> RenderableType:
    run = progress.runs[0]
    total = run.planned or run.updates
    frames = f"{run.last('frames'):,.0f} frames"
    spent = run.last("curriculum_frames")
    if spent:
        frames += f" + {spent:,.0f} of the curriculum"
    grid = Table.grid(padding=(0, 1))
    bar = ProgressBar(total=max(total, 1), completed=run.updates, width=WIDTH)
    grid.add_row(bar, f"{_updates(progress)} updates")
    return Group(grid, Text(f"{frames}, {run.last('seconds'):.0f} s"))


def _curves(runs: Sequence[Run]) -> RenderableType:
    grid = Table.grid(padding=(0, 1))
    for name in runs[0].measurements:
        # Of seeds that are trained together one can have a row more than another.
        known = min(len(run.metrics[name]) for run in runs)
        values = np.mean([run.metrics[name][:known] for run in runs], 0)
        rate = is_rate(name)
        low, high = (0, 1) if rate else (float(values.min()), float(values.max()))
        last = f"{values[-1]:.1%}" if rate else f"{values[-1]:.4g}"
        grid.add_row(Text(words(name)), Text(sparkline(_some(values), low, high)), last)
    return grid


def _cycles(run: Run) -> list[RenderableType]:
    """The gains of the replicas or else the curriculum's numbers, and its proposals."""
    cycle, grid = run.cycles[-1], Table.grid(padding=(0, 1))
    for name, text in GAINS.items():
        gains = [found for c in run.cycles if (found := numbers(c.get(name))) is not None]
        best, mean = [float(each.max()) for each in gains], [float(each.mean()) for each in gains]
        for kind, values in (("maximum", best), ("mean", mean)) if gains else ():
            drawn = sparkline(_some(values), min(0, *mean), max(0, *best))
            grid.add_row(f"{kind} gain in {text}", Text(drawn), f"{values[-1]:+.3f}")
    names = [n for n in cycle if n not in PLACE and n not in GAINS and n.isprintable()]
    for name in names[:NUMBERS] if not grid.row_count else ():
        values = [value for c in run.cycles if not math.isnan(value := number(c.get(name)))]
        if values:
            drawn = sparkline(_some(values), min(values), max(values))
            grid.add_row(Text(words(name)), Text(drawn), f"{values[-1]:.4g}")
    shares = run.shares(cycle)
    return [grid] if shares is None else [grid, *_map(run, share_map(shares))]


def _map(run: Run, shares: Column) -> list[RenderableType]:
    *above, (across, columns) = list(run.task.space.items())[:2]
    if max(shares.shape) > WIDEST_MAP:
        return []
    rows = [f"{value:g}" for _, values in above for value in values] or [""]
    grid = Table.grid(padding=(0, 1))
    largest = max(float(shares.max()), 2 / shares.size)
    for label, row in reversed(list(zip(rows, shares, strict=True))):
        cells = [SHADES[round(share / largest * (len(SHADES) - 1))] * 3 for share in row]
        grid.add_row(label, *map(Text, cells))
    grid.add_row("", *(f"{value:3g}" for value in columns))
    named = [f"rows: {name}" for name, _ in above] + [f"columns: {across}"]
    return [Text(f"proposals ({', '.join(named)})"), grid]


def _levels(run: Run) -> RenderableType:
    """The first levels of the last recorded batch that can be drawn in characters."""
    sample = run.samples[-1]
    drawn = [Text("\n".join(level.text)) for level in sample.levels[:LEVELS] if level.text]
    if not drawn:
        return Text("")
    key = f" ({run.task.text_key})" if run.task.text_key else ""
    title = f"{run.task.levels} at update {sample.updates}{key}"
    return Group(Text(title), Columns(drawn, padding=(0, 3)))


def _some(values: Sequence[float] | Column) -> Sequence[float] | Column:
    """Values, or as many of them as a curve has characters."""
    if len(values) <= WIDTH:
        return values
    return np.asarray(values)[np.linspace(0, len(values) - 1, WIDTH).round().astype(int)]


def _updates(progress: Progress) -> str:
    if not progress.runs:
        return "–"
    run = progress.runs[0]
    return f"{run.updates}/{run.planned}" if run.planned else str(run.updates)


def _headline(progress: Progress) -> str:
    if not progress.runs:
        return ""
    name = progress.runs[0].headline
    values = [run.last(name) for run in progress.runs]
    return f"{words(name)} {np.mean(values):.3f}"


def _age(progress: Progress) -> str:
    return f"{duration(progress.age)} ago"
