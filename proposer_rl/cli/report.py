"""``bin/report`` and ``proposer-report``: tables, figures and a page from folders of runs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from proposer_rl.cli.arguments import number
from proposer_rl.cli.errors import command
from proposer_rl.cli.help import choices, needs
from proposer_rl.cli.places import CONFIG_FOLDER

EPILOG = """\
examples:
  bin/report outputs                       every run below outputs/, to report/
  bin/report sweeps/quick -o results/quick
  bin/report a b c --threshold 0.5         three runs; sample efficiency at 50 %
  bin/report sweeps/quick --baseline target   everything measured against that method
  bin/report sweeps/medium --pages docs/findings/medium   the two pages of the docs
  bin/report sweeps/medium --publish results/medium/runs   the runs, for others to go on from
  bin/report outputs results/medium/runs   your runs beside published ones

The output folder gets report.html (one self-contained page), report.md (the same in short),
figures/ (SVG, PNG, animations) and tables/ (CSV, Markdown, and all measurements as tidy CSV).
Runs that were measured on different levels come in sections of their own. Unfinished runs are in
the figures as far as they got, not in the comparisons, and the report says so."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    parser = _parser()
    options = parser.parse_args(arguments)
    for name in ("scores", "seconds"):
        if getattr(options, name) and options.pages is None:
            parser.error(f"--{name}: only the pages of the docs take them up; give --pages, too")
    if options.publish is not None and (options.threshold, options.baseline) != (None, None):
        parser.error("--publish: copies runs, so neither --threshold nor --baseline has a meaning")
    command(partial(_run, options))


def _run(options: argparse.Namespace) -> None:
    from proposer_rl.report.reading import find_runs

    find_runs(options.folder)  # refuses what is none, before what takes seconds to import
    if options.pages is not None:
        from proposer_rl.report.pages import write_pages

        asked = (options.threshold, options.baseline, options.scores, options.seconds)
        for page in write_pages(options.folder, options.pages, needs([CONFIG_FOLDER]), *asked):
            print(f"Page: {page}")
        return
    if options.publish is not None:
        from proposer_rl.report.publish import publish

        copies, left_out = publish(options.folder, options.publish)
        print(*left_out, f"Runs: {len(copies)} in {options.publish}", sep="\n")
        return
    from proposer_rl.report.build import write_report

    page = write_report(
        options.folder,
        options.output,
        options.threshold,
        options.baseline,
        progress=not options.quiet,
        meanings={group: choices(group, [CONFIG_FOLDER]) for group in ("method", "ablation")},
    )
    print(f"Report: {page}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="bin/report",
        description="Write tables, figures and a page from the folders of runs.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "folder", nargs="+", type=Path, help="a run's folder, or one with runs in it at any depth"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "-o", "--output", type=Path, default=Path("report"), help="where to write (default: report)"
    )
    where.add_argument(
        "--pages",
        type=Path,
        metavar="FOLDER",
        help="write two pages of the docs there instead: which curriculum to use, and which claims "
        "hold",
    )
    where.add_argument(
        "--publish",
        type=Path,
        metavar="FOLDER",
        help="copy the finished runs there instead, without checkpoints and pictures of levels: "
        "small enough for a repository, and read as any runs are",
    )
    parser.add_argument(
        "--threshold",
        type=number(float),
        help="of sample efficiency, such as 0.8 of a success (default: the runs' own)",
    )
    parser.add_argument(
        "--baseline",
        metavar="METHOD",
        help="what the others are measured against, as the report calls it (default: "
        "domain_randomization, else the first)",
    )
    parser.add_argument(
        "--scores",
        type=Path,
        metavar="FILE",
        help="of these runs on further levels, as bin/eval writes them: for --pages",
    )
    parser.add_argument(
        "--seconds",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="of an update of each method, as bin/bench curricula --runs writes them; further "
        "files, of methods timed later beside some of those: for --pages",
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar")
    return parser


if __name__ == "__main__":
    main()
