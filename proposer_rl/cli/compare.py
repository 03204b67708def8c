"""Several runs on sets of levels: a table of methods, of their means."""

from __future__ import annotations

import argparse
import hashlib
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text
from tqdm import tqdm

from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.evaluate import Evaluation, evaluate, load
from proposer_rl.report.reading import begun, find_runs
from proposer_rl.report.runs import Run
from proposer_rl.report.scores import (
    LONGEST_NAME,
    Score,
    check_names,
    generalisation_table,
    read_scores,
    scored,
    stored_name,
    whole,
    write_scores,
)
from proposer_rl.report.studies import read_studies
from proposer_rl.runs.checkpoint import CheckpointError, checkpoint_files
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.lock import taking_turns


def of_several(options: argparse.Namespace) -> bool:
    """Whether ``bin/eval`` was asked about several runs or sets of levels."""
    if len(options.checkpoint) > 1 or len(options.levels) > 1:
        return True
    (path,) = options.checkpoint
    if not path.is_dir() or (path / "config.json").exists():
        return False
    return next(begun(path), None) is not None


def compare(options: argparse.Namespace) -> None:
    """Print a table of methods; what the output has of it is not computed again."""
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


def _stored(output: Path | None) -> list[Score]:
    return read_scores(output) if output is not None and output.exists() else []


def _added(new: list[Score], scores: list[Score], output: Path | None) -> list[Score]:
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
    run: Run, names: Sequence[str], scores: list[Score], max_steps: int | None
) -> list[Score]:
    """Scores of a run that are missing, or were of something else."""
    missing: list[Score] = []
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


def _summed(evaluation: Evaluation, name: str, digest: str) -> list[Score]:
    """The mean of each Solver."""
    summed, run = [], evaluation.run
    for solver, seed in enumerate(run.config.seeds):
        own = [each.results for each in evaluation.results if each.solver == solver]
        means = {key: float(np.mean([results[key] for results in own])) for key in own[0]}
        success = means.get("success", math.nan)
        place = (run.folder.name, seed, evaluation.updates, name, len(own))
        summed.append(Score(*place, success, means["return"], digest))
    return summed
