"""``bin/eval`` and ``proposer-eval``: evaluate a run's Solvers on named levels, one by one.

Help and refusals come before what takes seconds to import.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from proposer_rl.cli.errors import ConfigError, check_file, command, number
from proposer_rl.runs.folder import write_atomically

if TYPE_CHECKING:
    from proposer_rl.cli.stored import Stage, StoredRun
    from proposer_rl.task import LevelResult

MOST_STEPS = 10**5
SHOWN = 36  # levels in the table


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_run, _parser().parse_args(arguments)))


def _run(options: argparse.Namespace) -> None:
    check_file("output", options.output, ".json", ".csv")
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
        "one that ends in .txt, a run's curriculum.jsonl, or a set that comes along: "
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


class Evaluation(NamedTuple):
    """The results of Solvers on a set of levels."""

    run: StoredRun
    updates: int
    levels: str
    results: Sequence[LevelResult]

    def rows(self) -> list[dict[str, Any]]:
        """Returns a mapping for each level and Solver, for JSON and CSV."""
        return [
            {
                "run": self.run.folder.name,
                "seed": self.run.config.seeds[result.solver],
                "updates": self.updates,
                "level": result.level,
                **result.about,
                **result.results,
            }
            for result in self.results
        ]


def list_levels(options: argparse.Namespace) -> None:
    """Evaluates one run, prints its levels one by one, and writes the files asked for."""
    from proposer_rl.cli.stored import write_rows

    evaluation = evaluate(load(options.checkpoint), options.levels, options.max_steps)
    _print(evaluation)
    if options.output is not None and options.output.suffix == ".csv":
        from proposer_rl.report.tables import to_csv  # which takes seconds to import

        rows = evaluation.rows()
        table = to_csv(list(rows[0]), [list(row.values()) for row in rows])
        write_atomically(options.output, table.encode())
    else:
        write_rows(evaluation.rows(), options.output)


def load(checkpoint: Path) -> tuple[StoredRun, Stage]:
    """Loads the Solvers of a run's newest checkpoint, or of the checkpoint given."""
    from proposer_rl.cli.stored import stored_run

    run = stored_run(checkpoint)
    return run, run.stage(checkpoint if checkpoint.is_file() else None)


def evaluate(
    loaded: tuple[StoredRun, Stage], name: str | None, max_steps: int | None = None
) -> Evaluation:
    """Evaluates Solvers on a set of levels.

    Args:
        loaded: as :func:`load` returns them.
        name: of levels that the run's task knows; None for what it takes by default.
        max_steps: step limit of every level; None for the task's choice.
    """
    run, stage = loaded
    name = name or run.task.default_levels
    results = run.task.level_results(stage.learner.agent, name, max_steps)
    return Evaluation(run, stage.updates, name, results)


def _print(evaluation: Evaluation) -> None:
    shown, count = _hardest(evaluation.results), len({each.level for each in evaluation.results})
    some = f", the {len(shown)} hardest of {count} levels" if len(shown) < count else ""
    seeds = evaluation.run.config.seeds
    run = f"{evaluation.run.folder.name}, seed {', '.join(map(str, seeds))}"
    run += f", {evaluation.updates} updates"
    title = f"{run}: {evaluation.levels}{some}"
    caption = "Means over the seeds." if len(seeds) > 1 else ""
    table = Table(box=SIMPLE_HEAD, title=Text(title), caption=caption)
    table.add_column("level", overflow="fold", min_width=16)
    example = evaluation.results[0]
    for name in (*example.about, *example.results):
        table.add_column(name.replace("_", " "), justify="right")
    for of_level in shown:
        about = [f"{value:g}" for value in of_level[0].about.values()]
        table.add_row(Text(of_level[0].level), *about, *_means(of_level))
    table.add_section()
    table.add_row(f"mean of {count}", *[""] * len(example.about), *_means(evaluation.results))
    Console().print(table)


def _hardest(results: Sequence[LevelResult]) -> list[list[LevelResult]]:
    """Groups results by level, and keeps the levels with the least success or return if many.

    It is the mean over the Solvers that counts; levels stay in their order.
    """
    found: dict[str, list[LevelResult]] = {}
    for each in results:
        found.setdefault(each.level, []).append(each)
    kind = "success" if "success" in results[0].results else "return"
    ranked = sorted(found, key=lambda level: np.mean([each.results[kind] for each in found[level]]))
    kept = set(ranked[:SHOWN])
    return [of_level for level, of_level in found.items() if level in kept]


def _means(results: Sequence[LevelResult]) -> list[str]:
    names = results[0].results
    means = {name: sum(each.results[name] for each in results) / len(results) for name in names}
    return [f"{m:.1%}" if "success" in name else f"{m:.3f}" for name, m in means.items()]


if __name__ == "__main__":
    main()
