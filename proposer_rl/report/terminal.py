"""How far runs and sweeps are, drawn in characters: one run as a screen, several as a table."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from proposer_rl.report.reading import UnreadableRun, begun, read_run
from proposer_rl.report.runs import Run, share_map
from proposer_rl.runs.folder import FAILURE, is_rate
from proposer_rl.runs.process import PROGRESS
from proposer_rl.runs.records import (
    GAINS,
    LONGEST_TEXT,
    PLACE,
    Column,
    batch_shares,
    number,
    numbers,
    printable,
    small_json,
    words,
)

BLOCKS = " ▁▂▃▄▅▆▇█"
SHADES = " ░▒▓█"
COLOURS = {"finished": "green", "failed": "red", "unfinished": "yellow", "starting": "blue"}
WIDTH = 30  # characters of a curve
LEVELS = 3
NUMBERS = 8  # of a curriculum that is shown by its own
WIDEST_MAP = 20
STOPPED = 128  # a greater exit code is that of a signal: the run can go on


def duration(seconds: float) -> str:
    """Returns seconds as text in the unit that reads best."""
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"


@dataclass(frozen=True)
class Progress:
    """The state of one run's folder.

    Attributes:
        folder: of the run.
        runs: its seeds; empty if it has not measured anything yet, or failed before.
        failure: why it failed, in one line; empty if it did not.
        age: seconds since something was written.
        activity: what it was doing then, and how long the rest takes; empty if it does not say or
            has failed.
    """

    folder: Path
    runs: tuple[Run, ...]
    failure: str
    age: float
    activity: str = ""

    @property
    def state(self) -> str:
        """The state in a word: failed, finished, unfinished (or running), or starting."""
        if self.failure:
            return "failed"
        if not self.runs:
            return "starting"
        return "finished" if all(run.finished for run in self.runs) else "unfinished"


def read_progress(folder: Path) -> Progress:
    """Returns the state of a run's folder, also of one without measurements."""
    failure = _failure(folder)
    try:
        runs = tuple(read_run(folder))
    except UnreadableRun as error:
        runs = ()
        if not failure and (folder / "metrics.csv").is_file():
            failure = printable(str(error).removeprefix(f"{folder}: "))
    activity = "" if failure else _doing(folder)
    if activity and runs:
        activity = ", ".join(filter(None, [activity, _left(runs[0])]))
    return Progress(folder, runs, failure, _seconds_since(folder), activity)


def find_progress(folder: Path) -> list[Progress]:
    """Returns the states of all runs in a folder, or of the folder itself."""
    found = [read_progress(path) for path in begun(folder)]
    if not found:
        raise UnreadableRun(f"{folder}: no run in it, finished or begun")
    return found


def _failure(folder: Path) -> str:
    if not (folder / FAILURE).is_file():
        return ""
    match small_json(folder / FAILURE):
        case {"exit_code": int(code)} if code > STOPPED:
            return ""
        case {"message": message}:
            return printable(str(message))[:LONGEST_TEXT]
    return f"{FAILURE} cannot be read"


def _doing(folder: Path) -> str:
    """Returns a run's present activity; empty where it is over or the file cannot be read."""
    match small_json(folder / PROGRESS, 2**12):
        case {"doing": str(text)}:
            return printable(text)[:LONGEST_TEXT]
    return ""


def _left(run: Run) -> str:
    """Returns how long the rest takes at the mean speed so far; empty before the first update."""
    if not run.updates or run.planned is None:
        return ""
    rest = run.last("seconds") / run.updates * (run.planned - run.updates)
    since = time.time() - (run.folder / "metrics.csv").stat().st_mtime
    return f"about {duration(max(rest - since, 0.0))} left"


def _seconds_since(folder: Path) -> float:
    """Returns how long ago something in a folder was written; 0 where it is empty."""
    times = []
    for entry in os.scandir(folder):
        with suppress(FileNotFoundError):  # its temporary name is gone once a file is written
            if entry.is_file():
                times.append(entry.stat().st_mtime)
    return max(time.time() - max(times), 0.0) if times else 0.0


def screen(progress: Progress) -> RenderableType:
    """Returns one run's state, curves, last cycle and levels as a panel for the terminal."""
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
    """Returns a table with a line for each run, and the number of runs in each state."""
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
    """Returns values as blocks of rising height; values outside are drawn at the edge."""
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
    """Returns gains of replicas, or else the curriculum's numbers, then shares and proposals."""
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
            grid.add_row(Text(name.replace("_", " ")), Text(drawn), f"{values[-1]:.4g}")
    parts: list[RenderableType] = [grid]
    if batch := batch_shares(cycle):
        told = ", ".join(f"{name} {share:.0%}" for name, share in batch.items())
        parts.append(Text(f"of the batch: {told[:LONGEST_TEXT]}"))
    shares = run.shares(cycle)
    return parts if shares is None else [*parts, *_map(run, share_map(shares))]


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
    """Returns the first levels of the last recorded batch that can be drawn in characters."""
    sample = run.samples[-1]
    drawn = [Text("\n".join(level.text)) for level in sample.levels[:LEVELS] if level.text]
    if not drawn:
        return Text("")
    key = f" ({run.task.text_key})" if run.task.text_key else ""
    title = f"{run.task.levels} at update {sample.updates}{key}"
    return Group(Text(title), Columns(drawn, padding=(0, 3)))


def _some(values: Sequence[float] | Column) -> Sequence[float] | Column:
    """Returns the values, or as many of them, evenly spaced, as a curve has characters."""
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
