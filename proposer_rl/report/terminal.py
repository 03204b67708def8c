"""Runs drawn in characters: one run as a screen, several as a table."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

import numpy as np
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from proposer_rl.report.outcomes import words
from proposer_rl.report.progress import Progress
from proposer_rl.report.proposals import proposal_shares
from proposer_rl.report.runs import Run

BLOCKS = " ▁▂▃▄▅▆▇█"
SHADES = " ░▒▓█"
COLOURS = {"finished": "green", "failed": "red", "unfinished": "yellow", "starting": "blue"}
WIDTH = 30  # characters of a curve
LEVELS = 3


def screen(progress: Progress) -> RenderableType:
    """One run: how far it is, its curves, its last cycle, and what it trains on."""
    head = Text.assemble((progress.state, COLOURS[progress.state]), f", {_age(progress)}")
    if not progress.runs:
        return Panel(Group(head, Text(progress.failure)), title=_name(progress), title_align="left")
    run = progress.runs[0]
    parts: list[RenderableType] = [head, _bar(progress), _curves(progress.runs)]
    if run.cycles:
        parts.append(_cycle(run))
    if run.samples:
        parts.append(_levels(run))
    if progress.failure:
        parts.append(Text(progress.failure, style="red"))
    return Panel(Group(*parts), title=_name(progress), title_align="left")


def overview(found: Sequence[Progress]) -> RenderableType:
    """Several runs: one line each, and how many are in which state."""
    parent = os.path.commonpath([progress.folder.parent for progress in found])
    names = [str(progress.folder.relative_to(parent)) for progress in found]
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
    states = [progress.state for progress in found]
    counts = ", ".join(f"{states.count(state)} {state}" for state in COLOURS if state in states)
    return Group(table, *failures, Text(f"{len(found)} runs: {counts}"))


def sparkline(values: Iterable[float], low: float, high: float) -> str:
    """Values as blocks of rising height; values outside are drawn at the edge."""
    span = (high - low) or 1.0
    steps = [(value - low) / span * (len(BLOCKS) - 1) for value in values]
    return "".join(BLOCKS[min(max(round(step), 0), len(BLOCKS) - 1)] for step in steps)


def _name(progress: Progress) -> Text:
    if not progress.runs:
        return Text(progress.folder.name)
    run = progress.runs[0]
    seeds = ", ".join(str(run.seed) for run in progress.runs)
    ablation = "" if run.ablation == "none" else f", {run.ablation}"
    return Text(f"{run.method}{ablation}, seed {seeds}")


def _bar(progress: Progress) -> RenderableType:
    run = progress.runs[0]
    total = run.planned or run.updates
    frames = f"{run.metrics['frames'][-1]:,.0f} frames"
    copies = run.metrics["meta_frames"][-1]
    if copies:
        frames += f" + {copies:,.0f} of the copies"
    grid = Table.grid(padding=(0, 1))
    bar = ProgressBar(total=max(total, 1), completed=run.updates, width=WIDTH)
    grid.add_row(bar, f"{_updates(progress)} updates")
    return Group(grid, Text(f"{frames}, {run.metrics['seconds'][-1]:.0f} s"))


def _curves(runs: Sequence[Run]) -> RenderableType:
    grid = Table.grid(padding=(0, 1))
    for name in [f"{name}_success" for name in runs[0].config["evaluation"]["distributions"]]:
        values = np.mean([run.metrics[name] for run in runs], 0)
        if len(values) > WIDTH:
            values = values[np.linspace(0, len(values) - 1, WIDTH).round().astype(int)]
        grid.add_row(words(name), Text(sparkline(values, 0, 1)), f"{values[-1]:.1%}")
    return grid


def _cycle(run: Run) -> RenderableType:
    cycle = run.cycles[-1]
    gains = [float(np.mean(cycle["total_gain"])) for cycle in run.cycles]
    best = [float(np.max(cycle["total_gain"])) for cycle in run.cycles]
    low, high = min(0.0, *gains), max(*best, 0.0)
    grid = Table.grid(padding=(0, 1))
    grid.add_row("maximum gain", Text(sparkline(best, low, high)), f"{best[-1]:+.3f}")
    grid.add_row("mean gain", Text(sparkline(gains, low, high)), f"{gains[-1]:+.3f}")
    shares = proposal_shares(run, cycle)
    if shares is None:
        return grid
    return Group(grid, Text("proposals (rows: obstacles, columns: path length)"), _map(run, shares))


def _map(run: Run, shares: np.ndarray) -> RenderableType:
    space = run.config["space"]
    grid = Table.grid(padding=(0, 1))
    largest = max(float(shares.max()), 2 / shares.size)
    for fraction, row in reversed(list(zip(space["obstacle_fractions"], shares, strict=True))):
        cells = [SHADES[round(share / largest * (len(SHADES) - 1))] * 3 for share in row]
        grid.add_row(f"{fraction:g}", *map(Text, cells))
    grid.add_row("", *(f"{length:3g}" for length in space["path_lengths"]))
    return grid


def _levels(run: Run) -> RenderableType:
    """The first levels of the last recorded batch, with the cells that the Solver walked on."""
    sample = run.samples[-1]
    drawn = []
    for item in sample["levels"][:LEVELS]:
        lines = [list(line) for line in item["level"]]
        for row, column in item["path"]:
            if lines[row][column] == ".":
                lines[row][column] = "•"
        drawn.append(Text("\n".join(" ".join(line) for line in lines)))
    return Group(
        Text(f"levels at update {sample['updates']} (S start, G goal, • the Solver's episode)"),
        Columns(drawn, padding=(0, 3)),
    )


def _updates(progress: Progress) -> str:
    if not progress.runs:
        return "–"
    run = progress.runs[0]
    return f"{run.updates}/{run.planned}" if run.planned else str(run.updates)


def _headline(progress: Progress) -> str:
    if not progress.runs:
        return ""
    name = progress.runs[0].headline
    values = [float(run.metrics[name][-1]) for run in progress.runs]
    return f"{words(name)} {np.mean(values):.3f}"


def _age(progress: Progress) -> str:
    seconds = progress.age
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit} ago"
    return f"{seconds:.0f} s ago"
