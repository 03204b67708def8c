"""``bin/eval`` and ``proposer-eval``: evaluate a run's Solvers on named levels, one by one.

Help and refusals come before what takes seconds to import.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pandas as pd

from proposer_rl.cli.errors import ConfigError, check_file, command, number
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.records import encoded, printable

if TYPE_CHECKING:
    from proposer_rl.cli.build import Stage, StoredRun
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
    evaluation = evaluate(load(options.checkpoint), options.levels, options.max_steps)
    _print(evaluation)
    if options.output is not None:
        rows, as_csv = evaluation.rows(), options.output.suffix == ".csv"
        text = pd.DataFrame(rows).to_csv(index=False) if as_csv else json.dumps(rows, indent=1)
        write_atomically(options.output, encoded(text))


def load(checkpoint: Path) -> tuple[StoredRun, Stage]:
    """Loads the Solvers of a run's newest checkpoint, or of the checkpoint given."""
    from proposer_rl.cli.build import stored_run

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
    run, updates, levels, results = evaluation
    rows = [{"level": printable(one.level), **one.about, **one.results} for one in results]
    means = pd.DataFrame(rows).groupby("level", sort=False).mean()
    kind = "success" if "success" in means else "return"
    shown = means[means[kind].rank(method="first") <= SHOWN].copy()
    some = f", the {len(shown)} hardest of {len(means)} levels" if len(shown) < len(means) else ""
    seeds = ", ".join(map(str, run.config.seeds))
    print(f"{run.folder.name}, seed {seeds}, {updates} updates: {levels}{some}")
    if len(run.config.seeds) > 1:
        print("Means over the seeds.")
    texts = {name: "{:g}".format for name in results[0].about}
    texts |= {name: "{:.1%}".format for name in means if "success" in name}
    shown.loc[f"mean of {len(means)}"] = means.mean()
    print(shown.to_string(formatters=texts, float_format="{:.3f}".format, index_names=False))


if __name__ == "__main__":
    main()
