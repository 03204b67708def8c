"""What the instruments share: their options, their exit codes and the files of their rows."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from proposer_rl.cli.build import Stage, StoredRun, stored_run
from proposer_rl.cli.errors import ConfigError, check_file, command
from proposer_rl.runs.folder import write_atomically

Rows = list[dict[str, Any]]
STAGES = "A run keeps a checkpoint of every stage with schedule.keep_checkpoints=1000."


def checkpoints(folders: Sequence[Path]) -> Iterator[tuple[StoredRun, Stage]]:
    """The runs in some folders, each with every stage that it has kept; with a progress bar.

    Raises:
        ConfigError, CheckpointError: if a folder is no run's, or a checkpoint cannot be read.
    """
    runs = [stored_run(folder) for folder in folders]
    found = [(run, file) for run in runs for file in run.files]
    for run, file in tqdm(found, desc="checkpoints", disable=not sys.stderr.isatty()):
        yield run, run.stage(file)


def parser_of(name: str, description: str, seed: str, epilog: str = "") -> argparse.ArgumentParser:
    """A parser with the options of every instrument; ``seed`` says what the seed is of."""
    parser = argparse.ArgumentParser(
        prog=f"bin/research {name}", description=description, epilog=f"{epilog} {STAGES}".strip()
    )
    parser.add_argument("--seed", type=int, default=0, help=f"of {seed} (0)")
    parser.add_argument("-o", "--output", type=Path, help="a JSON file for the rows")
    return parser


def answer(
    options: argparse.Namespace,
    measure: Callable[[argparse.Namespace], Rows],
    show: Callable[[str, Rows], Table],
) -> None:
    """Measure, print a table for each run, and write the rows; bad input ends in one line."""

    def body() -> None:
        check_file("output", options.output, ".json")
        try:
            rows = measure(options)
        except (ValueError, TypeError) as error:
            raise error if hasattr(error, "exit_code") else ConfigError(str(error)) from error
        for run in dict.fromkeys(row["run"] for row in rows):
            Console().print(show(run, [row for row in rows if row["run"] == run]))
        write_rows(rows, options.output)

    command(body)


def write_rows(rows: Sequence[Any], file: Path | None) -> None:
    """Write rows as JSON, if a file is given."""
    if file is not None:
        write_atomically(file, (json.dumps(rows, indent=1) + "\n").encode())
