"""Trained Solvers on named levels.

One run's results are listed level by level, those of several by their means, as a table of
methods.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text
from tqdm import tqdm

from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.stored import Stage, StoredRun, stored_run, write_rows
from proposer_rl.report.reading import UnreadableRun, begun, find_runs
from proposer_rl.report.runs import Run
from proposer_rl.report.scores import (
    LONGEST_NAME,
    check_names,
    generalisation_table,
    read_scores,
    scored,
    stored_name,
    whole,
    write_scores,
)
from proposer_rl.report.scores import Score as RunScore
from proposer_rl.report.studies import read_studies
from proposer_rl.report.tables import to_csv
from proposer_rl.runs.checkpoint import CheckpointError, checkpoint_files
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.lock import taking_turns
from proposer_rl.task import LevelResult

SHOWN = 36  # levels in the table and on the sheet of pictures
COLUMNS, SIDE = 6, 1.9  # of the sheet, in levels and in inches


class Evaluation(NamedTuple):
    """The results of Solvers on a set of levels.

    Attributes:
        run: of the Solvers.
        updates: that they have made.
        levels: what was evaluated on.
        results: one for each level and Solver.
    """

    run: StoredRun
    updates: int
    levels: str
    results: Sequence[LevelResult]

    def rows(self) -> list[dict[str, Any]]:
        """One mapping for each level and Solver, for JSON and CSV."""
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


def run(options: argparse.Namespace) -> None:
    """Evaluate, print and write what ``bin/eval`` was asked."""
    if len(options.checkpoint) > 1 or len(options.levels) > 1 or _holds_runs(options):
        _compare(options)
    else:
        _one(options)


def _holds_runs(options: argparse.Namespace) -> bool:
    (path,) = options.checkpoint
    if not path.is_dir() or (path / "config.json").exists():
        return False
    return next(begun(path), None) is not None


def _one(options: argparse.Namespace) -> None:
    """One run, level by level."""
    (checkpoint,), name = options.checkpoint, next(iter(options.levels), None)
    _refuse_table(options.output)
    evaluation = evaluate(load(checkpoint), name, options.max_steps)
    _print(evaluation)
    if options.output is not None and options.output.suffix == ".csv":
        rows = evaluation.rows()
        table = to_csv(list(rows[0]), [list(row.values()) for row in rows])
        write_atomically(options.output, table.encode())
    else:
        write_rows(evaluation.rows(), options.output)
    if options.pictures is not None:
        write_atomically(options.pictures, _sheet(evaluation))


def _refuse_table(output: Path | None) -> None:
    """Scores of several runs, which may have taken hours, are not written over by those of one."""
    with suppress(UnreadableRun):
        if output is not None and output.is_file() and read_scores(output):
            raise ConfigError(f"--output {output}: has scores of several runs; name another file")


def _compare(options: argparse.Namespace) -> None:
    """Several runs on sets of levels: a table of methods; what the output has is not done again."""
    _check_comparison(options)
    output, names = options.output, options.levels
    studies, notes = read_studies(find_runs(options.checkpoint), None)
    scores = _stored(output)
    runs = whole(group for study in studies for group in study.groups)
    if not runs:
        raise ConfigError(
            f"{', '.join(map(str, options.checkpoint))}: no run is finished; several runs or sets "
            "of levels are compared at the runs' ends, only one run on one set before"
        )
    going = {run.folder for study in studies for run in study.runs} - {run.folder for run in runs}
    notes += [f"left out: {folder.name}: not finished" for folder in sorted(going)]
    check_names(runs)
    failures = 0
    for run in tqdm(runs, leave=False, disable=None):
        try:
            missing = _missing(run, names, scores, options.max_steps)
        except (ConfigError, CheckpointError) as error:  # of older code, say: the others count
            if len(runs) == (failures := failures + 1):
                raise
            notes.append(f"left out: {error}")
        else:
            scores = _added(missing, scores, output)
    for note in notes:
        print(note, file=sys.stderr)
    for study in studies:
        table_of = generalisation_table(study, [score for score in scores if score.levels in names])
        table = Table(box=SIMPLE_HEAD, title=Text(study.title), caption=table_of.note)
        for column in table_of.columns:
            table.add_column(Text(column), justify="left" if column == "method" else "right")
        for row in table_of.texts():
            table.add_row(*map(Text, row))
        Console().print(table)


def _check_comparison(options: argparse.Namespace) -> None:
    """Refuse what several runs or sets of levels cannot be asked for, before anything is read."""
    output, names = options.output, options.levels
    for path in options.checkpoint:
        if path.is_file():
            raise ConfigError(
                f"{path}: is a file; several runs or sets of levels take folders of runs only: "
                "give a checkpoint alone, with one set"
            )
    if options.pictures is not None:
        raise ConfigError("--pictures: give one run and one set of levels")
    if not names:
        raise ConfigError("--levels: name the sets of levels on which several runs are compared")
    for name in names:
        if name != (stored := stored_name(name)):
            raise ConfigError(
                f"--levels {stored:.80}: the table of several runs takes names of one line, of at "
                f"most {LONGEST_NAME} printable characters"
            )
    if output is not None and output.suffix != ".csv":
        raise ConfigError(f"--output {output}: the scores of several runs are written as .csv")
    if options.max_steps is not None and output is not None:
        raise ConfigError(f"--max-steps: --output {output} does not record it; leave one out")


def _stored(output: Path | None) -> list[RunScore]:
    return read_scores(output) if output is not None and output.exists() else []


def _added(new: list[RunScore], scores: list[RunScore], output: Path | None) -> list[RunScore]:
    """Scores with new ones in place of older ones, as they then stand in the output.

    Where there is one it counts as it is by now: other processes may have added to it.
    """
    places = {score[:4] for score in new}
    if output is None or not new:
        return [score for score in scores if score[:4] not in places] + new
    with taking_turns(output):
        scores = _added(new, _stored(output), None)
        write_atomically(output, write_scores(scores))
    return scores


def _missing(
    run: Run, names: Sequence[str], scores: list[RunScore], max_steps: int | None
) -> list[RunScore]:
    """Scores of a run that are missing, or were of something else."""
    missing: list[RunScore] = []
    loaded = None
    for name in names:
        digest, known = _digest(run.folder, name), scored(run, scores, name)
        if known is None or digest not in ("", known.digest):
            loaded = loaded or load(run.folder)
            missing += _summed(evaluate(loaded, name, max_steps), name, digest)
    return missing


def _digest(folder: Path, levels: str) -> str:
    """Of a run's settings and newest checkpoint, and of the levels where they are a file.

    Returns:
        16 hexadecimal digits; nothing for a run without checkpoints.
    """
    checkpoints = checkpoint_files(folder / "checkpoints")
    if not checkpoints:
        return ""
    files = [folder / "config.json", checkpoints[-1][1], Path(levels)]
    digest = hashlib.sha256()
    for file in files:
        if file.is_file():
            digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


def _summed(evaluation: Evaluation, name: str, digest: str) -> list[RunScore]:
    """The mean of each Solver."""
    summed, run = [], evaluation.run
    for solver, seed in enumerate(run.config.seeds):
        own = [each.results for each in evaluation.results if each.solver == solver]
        means = {key: float(np.mean([results[key] for results in own])) for key in own[0]}
        success = means.get("success", math.nan)
        place = (run.folder.name, seed, evaluation.updates, name, len(own))
        summed.append(RunScore(*place, success, means["return"], digest))
    return summed


def load(checkpoint: Path) -> tuple[StoredRun, Stage]:
    """The Solvers of a run's newest checkpoint, or of the one that is given.

    Raises:
        ConfigError, CheckpointError: if there is no such run, or its checkpoint cannot be used.
    """
    run = stored_run(checkpoint)
    return run, run.stage(checkpoint if checkpoint.is_file() else None)


def evaluate(
    loaded: tuple[StoredRun, Stage], name: str | None, max_steps: int | None = None
) -> Evaluation:
    """Evaluate Solvers on a set of levels.

    Args:
        loaded: as :func:`load` returns them.
        name: of levels that the run's task knows; None for what it takes by default.
        max_steps: step limit of every level; None for the task's choice.

    Raises:
        ValueError: if there are no such levels, or they are none for this Solver.
        OSError: if a file cannot be read.
    """
    run, stage = loaded
    name = name or run.task.default_levels
    results = run.task.level_results(stage.learner.agent, name, max_steps)
    return Evaluation(run, stage.updates, name, results)


def _print(evaluation: Evaluation) -> None:
    first = [each for each in evaluation.results if each.solver == 0]
    shown = _hardest(first)
    some = f", the {len(shown)} hardest of {len(first)} levels" if len(shown) < len(first) else ""
    seeds = evaluation.run.config.seeds
    run = f"{evaluation.run.folder.name}, seed {', '.join(map(str, seeds))}"
    run += f", {evaluation.updates} updates"
    title = f"{run}: {evaluation.levels}{some}"
    caption = "Means over the seeds." if len(seeds) > 1 else ""
    table = Table(box=SIMPLE_HEAD, title=Text(title), caption=caption)
    table.add_column("level", overflow="fold", min_width=16)
    for name in (*first[0].about, *first[0].results):
        table.add_column(name.replace("_", " "), justify="right")
    for level in shown:
        of_level = [other for other in evaluation.results if other.level == level.level]
        about = [f"{value:g}" for value in level.about.values()]
        table.add_row(Text(level.level), *about, *_means(of_level))
    table.add_section()
    table.add_row(f"mean of {len(first)}", *[""] * len(first[0].about), *_means(evaluation.results))
    Console().print(table)


def _hardest(results: Sequence[LevelResult]) -> list[LevelResult]:
    """All of a few levels; of many those with the least success, or return, in their order."""
    ranked = sorted(results, key=lambda each: each.results.get("success", each.results["return"]))
    kept = {each.level for each in ranked[:SHOWN]}
    return [each for each in results if each.level in kept]


def _means(results: Sequence[LevelResult]) -> list[str]:
    names = results[0].results
    means = {name: sum(each.results[name] for each in results) / len(results) for name in names}
    return [f"{m:.1%}" if "success" in name else f"{m:.3f}" for name, m in means.items()]


def _sheet(evaluation: Evaluation) -> bytes:
    """Pictures of the first Solver on the hardest levels side by side, a PNG file."""
    shown = _hardest([each for each in evaluation.results if each.solver == 0])
    columns = min(COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(max(SIDE * columns, 5), (SIDE + 0.45) * rows + 0.7), layout="tight")
    # Names come from files: a dollar sign in one is no formula.
    title = f"{evaluation.run.folder.name}, {evaluation.updates} updates"
    figure.suptitle(title, fontsize=9, parse_math=False)
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, level in zip(grid.flat, shown, strict=False):
        axes.imshow(level.picture())
        result = level.results.get("success", level.results["return"])
        caption = f"{level.level}: {result:.3g}\n{level.note}"
        axes.set_title(caption, fontsize=7, parse_math=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return file.getvalue()
