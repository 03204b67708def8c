"""``bin/bench``: what it is asked; its help comes before what takes seconds to import."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from proposer_rl.cli.errors import command, number


def main() -> None:
    """Entry point; 1 if a benchmark failed, else the exit codes are those of ``cli/errors.py``."""
    command(partial(_answer, _parser().parse_args()))


def _answer(arguments: argparse.Namespace) -> None:
    from research.benchmarks.command import answer

    answer(arguments)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bench",
        description="Measure speed and memory, each against something timed beside it.",
        epilog="docs/explanation/performance.md says what the rows mean.",
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="benchmarks; default: see --list")
    parser.add_argument("--list", action="store_true", help="list the benchmarks and stop")
    parser.add_argument("--output", type=Path, default=Path("bench.json"), metavar="FILE")
    parser.add_argument(
        "--repeats", type=number(int, 1), default=5, help="rounds of each comparison"
    )
    parser.add_argument(
        "--threads", type=number(int, 1), help="CPU threads; default: torch's choice"
    )
    parser.add_argument(
        "--precision",
        choices=["auto", "fp32", "bf16"],
        default="auto",
        help="where not both are compared; auto: bf16 for the wide network if the processor has it",
    )
    parser.add_argument("--device", default="auto", help="auto (cuda where there is one), cpu, ...")
    parser.add_argument(
        "--jaxued",
        metavar="PYTHON",
        help="an interpreter that has jaxued: view and view_training measure it, too, on the CPU",
    )
    parser.add_argument(
        "--syllabus",
        metavar="PYTHON",
        help="an interpreter that has syllabus-rl: teacher times its calls, too",
    )
    parser.add_argument(
        "--runs",
        nargs="+",
        default=[],
        metavar="FOLDER",
        help="with runs in them: curricula times their methods in whole cycles and their precision",
    )
    parser.add_argument(
        "--seeds",
        type=number(int, 0),
        nargs="+",
        default=[100, 101, 102, 103, 104],
        metavar="SEED",
        help="of gymnasium; what is in gymnasium.csv beside the output is not trained again",
    )
    parser.add_argument(
        "--environments", nargs="+", default=[], metavar="NAME", help="of gymnasium; default: all"
    )
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--full", action="store_true", help="the paper's values throughout (longer)")
    size.add_argument("--tiny", action="store_true", help="only see that everything runs")
    return parser


if __name__ == "__main__":
    main()
