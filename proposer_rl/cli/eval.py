"""``bin/eval`` and ``proposer-eval``: help and refusals, before what takes seconds to import."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from proposer_rl.cli.errors import ConfigError, check_file, command, number

MOST_STEPS = 10**5


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_run, _parser().parse_args(arguments)))


def _run(options: argparse.Namespace) -> None:
    check_file("output", options.output, ".json", ".csv")
    from proposer_rl.cli.evaluate import list_levels

    try:
        list_levels(options)
    except ValueError as error:
        raise error if hasattr(error, "exit_code") else ConfigError(str(error)) from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/eval",
        description="Evaluate a trained Solver on named levels, one by one: as exactly as its task "
        "can, on levels of any size where it has files of them.",
        epilog="docs/how_to/levels.md describes such files and the sets that come along.",
    )
    parser.add_argument("checkpoint", type=Path, help="a run's folder, or one of its checkpoints")
    parser.add_argument(
        "--levels",
        metavar="FILE|NAME",
        help="a distribution of the run such as id or ood; where the task has files of levels also "
        "one that ends in .txt or .json, a run's curriculum.jsonl, or a set that comes along: "
        "shapes, the default there, or small; where levels are grids, NAME@HxW is a distribution "
        "on another one",
    )
    parser.add_argument(
        "--max-steps",
        type=number(int, 1, MOST_STEPS),
        metavar="N",
        help="step limit of every level, where the task lets it be chosen (the run's, or on levels "
        "that are none of a distribution 2 for each move of the shortest path if this is more)",
    )
    parser.add_argument(
        "-o", "--output", type=Path, help="a file for the rows that ends in .json or .csv"
    )
    return parser


if __name__ == "__main__":
    main()
