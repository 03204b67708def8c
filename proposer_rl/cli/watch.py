"""``bin/watch`` and ``proposer-watch``: shows running experiments; nothing is written."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.live import Live

from proposer_rl.cli.errors import command, number
from proposer_rl.report.terminal import find_progress, overview

EPILOG = """\
examples:
  bin/watch outputs/perf_gain/2026-11-21_00-37-50_seed_0   one run
  bin/watch sweeps/quick                                   a sweep: one line for each run
  bin/watch sweeps/quick --once                            print once, for a file or a pipe"""


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
            time.sleep(options.seconds)
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
    parser.add_argument(
        "--seconds",
        type=number(float, 0.1, 3600),
        default=2.0,
        help="between two refreshes (default: 2)",
    )
    return parser


if __name__ == "__main__":
    main()
