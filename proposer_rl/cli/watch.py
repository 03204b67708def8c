"""``bin/watch`` and ``proposer-watch``: show running experiments; nothing is written.

And the picture and the lines with which a run ends, and the table with which a sweep does: training
is given them and knows nothing of what draws; figures take a while to import.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from proposer_rl.cli.errors import command, say
from proposer_rl.report.reading import UnreadableRun, begun, read_run
from proposer_rl.report.runs import Run
from proposer_rl.runs.folder import FAILURE, is_rate
from proposer_rl.runs.records import LONGEST_TEXT, Column, level_text, printable, small_json, words

EPILOG = """\
examples:
  bin/watch outputs/perf_gain/2026-11-21_00-37-50_seed_0   one run
  bin/watch sweeps/quick                                   a sweep: one line for each run
  bin/watch sweeps/quick --once                            print once, for a file or a pipe"""
BLOCKS = " ▁▂▃▄▅▆▇█"
COLOURS = {"finished": "green", "failed": "red", "unfinished": "yellow", "starting": "blue"}
WIDTH = 16  # characters of a curve
SECONDS = 2.0  # between two refreshes
STOPPED = 128  # greater exit codes are of signals, after which a run can be resumed


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command until Ctrl-C; other exit codes are those of ``cli/errors.py``."""
    command(partial(_run, _parser().parse_args(arguments)))


def _run(options: argparse.Namespace) -> None:
    console = Console()
    table = overview(find_progress(options.folder))
    if options.once or not console.is_terminal:
        console.print(table)
        return
    shown = Live(table, console=console, auto_refresh=False, screen=True)
    with suppress(KeyboardInterrupt), shown as live:
        while console.is_terminal:  # until it is closed
            time.sleep(SECONDS)
            live.update(overview(find_progress(options.folder)), refresh=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/watch",
        description="Draw the state of a run or a sweep in the terminal, again and again.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="a run's folder, or one with runs in it")
    parser.add_argument("--once", action="store_true", help="draw once and stop")
    return parser


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
    """

    folder: Path
    runs: tuple[Run, ...]
    failure: str
    age: float

    @property
    def state(self) -> str:
        """The state: failed, finished, unfinished (or running), or starting."""
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
    return Progress(folder, runs, failure, _seconds_since(folder))


def find_progress(folder: Path) -> list[Progress]:
    """Returns the states of all runs in a folder, or of the folder itself."""
    found = [read_progress(path) for path in begun(folder)]
    if not found:
        raise UnreadableRun(f"{folder}: holds no runs, finished or begun")
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


def _seconds_since(folder: Path) -> float:
    """Returns how long ago something in a folder was written; 0 where it is empty."""
    times = []
    for entry in os.scandir(folder):
        with suppress(FileNotFoundError):  # a temporary file may have got its name meanwhile
            if entry.is_file():
                times.append(entry.stat().st_mtime)
    return max(time.time() - max(times), 0.0) if times else 0.0


def overview(found: Sequence[Progress]) -> RenderableType:
    """Returns a table with a line for each run, and the number of runs in each state."""
    parent = os.path.commonpath([progress.folder.parent for progress in found])
    names = [printable(str(progress.folder.relative_to(parent))) for progress in found]
    table = Table(box=None, pad_edge=False)
    table.add_column("run", overflow="fold")
    columns = {"state": 10, "updates": 7, "": WIDTH, "last": 16, "written": 10}
    for name, width in columns.items():
        table.add_column(name, no_wrap=True, min_width=width)
    for name, progress in zip(names, found, strict=True):
        table.add_row(
            Text(name),
            Text(progress.state, style=COLOURS[progress.state]),
            *map(Text, _measured(progress.runs)),
            f"{duration(progress.age)} ago",
        )
    told = [
        Text(f"failed: {name}: {progress.failure}", style="red")
        for name, progress in zip(names, found, strict=True)
        if progress.failure
    ]
    states = [progress.state for progress in found]
    counts = ", ".join(f"{states.count(state)} {state}" for state in COLOURS if state in states)
    total = "1 run" if len(found) == 1 else f"{len(found)} runs"
    return Group(table, *told, Text(f"{total}: {counts}"))


def _measured(runs: Sequence[Run]) -> tuple[str, str, str]:
    """Returns the updates, the headline's curve and its last value as texts: the seeds' mean."""
    if not runs:
        return "–", "", ""
    run = runs[0]
    # A seed can be one row ahead of those that are trained with it.
    known = min(len(each.metrics[run.headline]) for each in runs)
    values = np.mean([each.metrics[run.headline][:known] for each in runs], 0)
    low, high = (0, 1) if is_rate(run.headline) else (float(values.min()), float(values.max()))
    updates = f"{run.updates}/{run.planned}" if run.planned else str(run.updates)
    curve = sparkline(_some(values), low, high)
    return updates, curve, f"{words(run.headline)} {values[-1]:.3f}"


def sparkline(values: Iterable[float], low: float, high: float) -> str:
    """Returns values as blocks of rising height; values outside are drawn at the edge."""
    span = (high - low) or 1.0
    steps = [(value - low) / span * (len(BLOCKS) - 1) for value in values]
    return "".join(BLOCKS[min(max(round(step), 0), len(BLOCKS) - 1)] for step in steps)


def _some(values: Sequence[float] | Column) -> Sequence[float] | Column:
    """Returns at most as many values, evenly spaced, as a curve has characters."""
    if len(values) <= WIDTH:
        return values
    return np.asarray(values)[np.linspace(0, len(values) - 1, WIDTH).round().astype(int)]


def show_sweep(folder: Path) -> None:
    """Lists the runs of a sweep that is over."""
    Console().print(overview(find_progress(folder)))


def draw_run(folder: Path, title: str) -> Path:
    """Draws ``run.png`` of a run's folder; returns the file."""
    from proposer_rl.report import figures

    return figures.draw_run(folder, title)


def show_run(folder: Path, name: str, result: Mapping[str, Any]) -> None:
    """Draws the picture of a run that is over, and prints its summary."""
    picture, seeds = draw_run(folder, name), result["seeds"]
    for seed, reached, final in zip(
        seeds, result["updates_to_threshold"], result["final"], strict=True
    ):
        say(f"{result['method']}, seed {seed}: {_outcome_text(result, reached, final)}")
    say(_cost_text(result, len(seeds)))
    say(f"Files: {folder}  (picture: {picture.name})")


def _outcome_text(
    result: Mapping[str, Any], reached: int | None, final: Mapping[str, float]
) -> str:
    headline = result["headline"]
    level = f"{level_text(headline, result['threshold'])} {headline.replace('_', ' ')}"
    end = f"{final[headline]:.1%}" if is_rate(headline) else f"{final[headline]:.3g}"
    outcome = (
        f"{level} after {reached} updates"
        if reached is not None
        else f"{level} not reached in {result['updates']} updates (censored)"
    )
    return f"{outcome}; {end} at the end."


def _cost_text(result: Mapping[str, Any], seeds: int) -> str:
    together = f" for each of {seeds} seeds" if seeds > 1 else ""
    return (
        f"Cost: {result['frames']:,} frames of the Solver{together}, "
        f"{result['curriculum_frames']:,} of its curriculum, {result['seconds']:.0f} s."
    )


if __name__ == "__main__":
    main()
