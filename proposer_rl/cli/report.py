"""``bin/report`` and ``proposer-report``: a report, or a study to publish, from runs."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from proposer_rl.cli.errors import command, number
from proposer_rl.cli.help import choices
from proposer_rl.recipes import CONFIG_FOLDER

EPILOG = """\
examples:
  bin/report outputs                       every run below outputs/, to report/
  bin/report sweeps/quick -o results/quick
  bin/report a b c --threshold 0.5         three runs; sample efficiency at 50 %
  bin/report sweeps/quick --baseline target   everything measured against that method
  bin/report outputs --compare perf_gain,plr  one comparison was planned: p corrects for it alone
  bin/report outputs results/medium        your runs beside published ones
  bin/report sweeps/medium --publish results/medium   a study for a repository, no report
  bin/report plr.jsonl uniform.jsonl       logs of teachers, teacher.log(file)

The output folder gets report.html (one self-contained page), report.md (the same in short),
figures/ (SVG, PNG) and tables/ (CSV, Markdown, and all measurements as tidy CSV).
Runs that were measured on different levels come in sections of their own. Runs shorter than most of
the finished ones are named; they are in the figures as far as they got, not in the comparisons."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_run, _parser().parse_args(arguments)))


def _run(options: argparse.Namespace) -> None:
    from proposer_rl.report.reading import find_runs
    from proposer_rl.runs.records import printable

    # Refuse wrong folders before slow imports.
    find_runs([path for path in options.folder if path.suffix != ".jsonl"])
    compare = re.split(r",(?! )", options.compare) if options.compare else ()
    asked = options.threshold, options.baseline or (), compare
    if options.publish:
        from proposer_rl.report.publish import publish

        written, left_out = publish(options.folder, options.publish, *asked)
        print(*map(printable, [*left_out, f"Runs: {written} in {options.publish}"]), sep="\n")
        return
    from proposer_rl.report.build import write_report

    page = write_report(
        options.folder,
        options.output,
        *asked,
        meanings={group: choices(group, [CONFIG_FOLDER]) for group in ("method", "ablation")},
    )
    print(printable(f"Report: {page}"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/report",
        description="Write a page, figures and tables that compare runs, or publish the runs.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "folder",
        nargs="+",
        type=Path,
        help="a run's folder, or one with runs in it at any depth; a log of a teacher, *.jsonl",
    )
    output = parser.add_mutually_exclusive_group()
    output.add_argument(
        "-o", "--output", type=Path, default=Path("report"), help="where to write (default: report)"
    )
    output.add_argument(
        "--publish",
        type=Path,
        metavar="STUDY",
        help="write no report, but the finished runs as a study to this folder: their tables, and "
        "a README.md with figures; of a study that is there, runs of the same names are replaced",
    )
    parser.add_argument(
        "--threshold",
        type=number(float),
        help="of sample efficiency, such as 0.8 of a success (default: the runs' own)",
    )
    parser.add_argument(
        "--baseline",
        metavar="METHOD",
        action="append",
        help="what the others are measured against, as the report calls it (default: "
        "domain_randomization, else the first); again for more, of which several tasks take the "
        "better one (default: domain_randomization and target)",
    )
    parser.add_argument(
        "--compare",
        metavar="METHOD,METHOD",
        help="the methods whose comparison was planned, as the report calls them: p-values are "
        "corrected for these alone (default: for all methods)",
    )
    return parser


if __name__ == "__main__":
    main()
