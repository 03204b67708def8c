"""Finished runs on sets of levels: a table of methods, of their means.

With ``-o`` a line for each Solver and set is added to a file; what is in it is not computed again.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from filelock import FileLock
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text
from tqdm import tqdm

from proposer_rl.cli.errors import ConfigError, check_file, command
from proposer_rl.cli.eval import Evaluation, evaluate, load
from proposer_rl.report.reading import find_runs
from proposer_rl.report.runs import Run
from proposer_rl.report.studies import read_studies
from proposer_rl.runs.checkpoint import CheckpointError, checkpoint_files
from proposer_rl.runs.folder import storage, write_atomically
from research.generalisation import (
    Score,
    check_names,
    generalisation_table,
    read_scores,
    scored,
    whole,
    write_scores,
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    options = _parser().parse_args(arguments)
    command(lambda: compare(options.folder, options.levels, options.output))


def compare(folders: Sequence[Path], names: Sequence[str], output: Path | None) -> None:
    """Print a table of methods; new scores are added to the output where there is one."""
    check_file("output", output, ".csv")
    studies, notes = read_studies(find_runs(folders), None)
    scores = _stored(output)
    runs = whole(group for study in studies for group in study.groups)
    if not runs:
        raise ConfigError(f"{', '.join(map(str, folders))}: no run is finished")
    going = {run.folder for study in studies for run in study.runs} - {run.folder for run in runs}
    notes += [f"left out: {folder.name}: not finished" for folder in sorted(going)]
    check_names(runs)
    failures = 0
    for run in tqdm(runs, leave=False, disable=None):
        try:
            missing = _missing(run, names, scores)
        except (ConfigError, CheckpointError) as error:  # of older code, say: the others count
            if len(runs) == (failures := failures + 1):
                raise
            notes.append(f"left out: {error}")
        except ValueError as error:
            raise error if hasattr(error, "exit_code") else ConfigError(str(error)) from error
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


def _stored(output: Path | None) -> list[Score]:
    return read_scores(output) if output is not None and output.exists() else []


def _added(new: list[Score], scores: list[Score], output: Path | None) -> list[Score]:
    """Scores with new ones in place of older ones, as they then stand in the output.

    Where there is one it counts as it is by now: other processes may have added to it.
    """
    places = {score[:4] for score in new}
    if output is None or not new:
        return [score for score in scores if score[:4] not in places] + new
    with storage(output), FileLock(output.with_name(f".{output.name}.lock")):
        scores = _added(new, _stored(output), None)
        write_atomically(output, write_scores(scores))
    return scores


def _missing(run: Run, names: Sequence[str], scores: list[Score]) -> list[Score]:
    """Scores of a run that are missing, or were of something else."""
    missing: list[Score] = []
    loaded = None
    for name in names:
        digest, known = _digest(run.folder, name), scored(run, scores, name)
        if known is None or digest not in ("", known.digest):
            loaded = loaded or load(run.folder)
            missing += _summed(evaluate(loaded, name), name, digest)
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bin/research scores", description=__doc__)
    parser.add_argument("folder", nargs="+", type=Path, help="of a run, or with runs in it")
    parser.add_argument(
        "--levels", nargs="+", required=True, metavar="FILE|NAME", help="sets, as bin/eval has them"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="ends in .csv")
    return parser


if __name__ == "__main__":
    main()
