"""What Solvers do at the end on levels of other sets than those measured along training."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from proposer_rl.report.comparisons import Outcome, at_the_end
from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import INTERVALS
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import Cell, Table
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import encoded, number, words


class Score(NamedTuple):
    """A Solver's mean over a set of levels.

    Attributes:
        run: name of its folder.
        seed: its own.
        updates: after so many.
        levels: name of the set.
        size: how many levels it has.
        success: NaN where the task has none.
        returns: the mean return.
        digest: of what it was measured on and with; empty where that is not known.
    """

    run: str
    seed: int
    updates: int
    levels: str
    size: int
    success: float
    returns: float
    digest: str


def write_scores(scores: Iterable[Score]) -> bytes:
    """Scores as CSV."""
    return encoded(pd.DataFrame(scores).to_csv(index=False, float_format="%.6g"))


def read_scores(file: Path) -> list[Score]:
    """Scores as ``bin/research scores`` writes them."""
    try:
        rows = csv.DictReader(io.StringIO(file.read_text(encoding="utf-8-sig")))
        return [
            Score(
                row["run"],
                int(row["seed"]),
                int(row["updates"]),
                row["levels"],
                int(row["size"]),
                number(float(row["success"] or "nan")),
                number(float(row["returns"] or "nan")),
                row["digest"],
            )
            for row in rows
        ]
    except (csv.Error, ValueError, KeyError, TypeError) as error:
        raise UnreadableRun(f"{file}: holds no scores of runs of bin/research scores") from error


def check_names(runs: Iterable[Run]) -> None:
    """Scores know runs by the names of their folders: refuse two that they would take for one."""
    found: dict[tuple[str, int, int], Path] = {}
    for run in runs:
        other = found.setdefault((run.folder.name, run.seed, run.updates), run.folder)
        if other != run.folder:
            raise UnreadableRun(
                f"{run.folder}: scores could not tell it from {other}, which has its name; give "
                "one of their folders at a time"
            )


def scored(run: Run, scores: Sequence[Score], levels: str) -> Score | None:
    """A run's score on a set at its end; None where there is none."""
    key = (run.folder.name, run.seed, run.updates, levels)
    return next((score for score in scores if score[:4] == key), None)


def generalisation_table(study: Study, scores: Sequence[Score]) -> Table:
    """One row per method: its mean on each set, and on the worst tenth of what was measured on."""
    sets = list(dict.fromkeys(score.levels for score in scores))
    worst = [f"{name}_worst10" for name in study.measurements if name != study.headline]
    worst = [name for name in worst if any(name in run.metrics for run in study.runs)]
    rows: list[dict[str, Cell]] = []
    for group in study.compared:
        row: dict[str, Cell] = {"method": group.label}
        for levels in sets:
            value = partial(_result, scores=scores, levels=levels, study=study)
            row[levels] = Outcome(levels, value).median(group)
        for name in worst:
            title = words(name).replace("worst10", "on the worst 10 %")
            row[title] = at_the_end(study, name).median(group)
        rows.append(row)
    measure = "Success" if is_rate(study.headline) else "Return"
    note = (
        f"{measure} after {study.horizon} updates, mean over the {study.example.task.levels} of "
        f"each set. {INTERVALS}"
    )
    return Table("generalisation", "Other levels", note, rows)


def _result(run: Run, scores: Sequence[Score], levels: str, study: Study) -> float:
    score = scored(run, scores, levels)
    if score is None:
        return math.nan
    return score.success if is_rate(study.headline) else score.returns


def whole(groups: Iterable[Group]) -> list[Run]:
    """The finished runs of some groups, one of each folder."""
    runs = (run for group in groups for run in group.runs if run.finished)
    return list({run.folder: run for run in runs}.values())
