"""What came out: one row per run, per group, and per pair of groups."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from proposer_rl.report import records
from proposer_rl.report.records import LONGEST_TEXT, level_text, words
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import (
    Interval,
    Values,
    interquartile_mean,
    mean_difference,
    mean_interval,
    probability_of_improvement,
    pseudo_values,
    restricted_difference,
    restricted_interval,
    seeds_needed,
)
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.tables import Cell, Table

MILLION = 1e6
MOST_COLUMNS, DEEPEST = 200, 8


class Comparison(NamedTuple):
    """Two groups by one outcome.

    Attributes:
        one, other: their labels.
        outcome: what is compared.
        difference: of ``one`` minus ``other``.
        better: the label of the better group, None where the interval includes zero.
        improvement: probability that a run of ``one`` is better than a run of ``other``.
        seeds: per group, with which a difference as large as the one seen would be found.
    """

    one: str
    other: str
    outcome: str
    difference: Interval
    better: str | None
    improvement: Interval
    seeds: int | None


class Outcome(NamedTuple):
    """A number for each run of a group, and how two groups differ by it.

    Attributes:
        name: with its unit.
        values: one per run that can be counted.
        difference: of two groups.
        sign: 1 where more is better, -1 where less is.
    """

    name: str
    values: Callable[[Group], Values]
    difference: Callable[[Group, Group], Interval]
    sign: int


def outcomes(study: Study) -> list[Outcome]:
    """What groups of a study are compared by; the sample efficiency comes first."""
    headline, horizon = study.headline, study.horizon

    def plain(name: str, value: Callable[[Run], float]) -> Outcome:
        def values(group: Group) -> list[float]:
            return [one for run in group.runs if not math.isnan(one := value(run))]

        return Outcome(name, values, lambda a, b: mean_difference(values(a), values(b)), 1)

    mean = f"{words(headline)}, mean over {horizon} updates"
    return [
        waiting_outcome(study, study.threshold),
        plain(mean, lambda run: run.mean_until(headline, horizon)),
        *(
            plain(
                f"{words(name)} after {horizon} updates",
                partial(Run.at, measurement=name, updates=horizon),
            )
            for name in study.measurements
        ),
    ]


def waiting_outcome(study: Study, threshold: float) -> Outcome:
    """Restricted updates to a threshold of the headline measurement."""
    name, limit = study.headline, study.restricted_to(threshold)

    def difference(one: Group, other: Group) -> Interval:
        waiting = [group.waiting(name, threshold) for group in (one, other)]
        return restricted_difference(waiting[0], waiting[1], limit)

    return Outcome(
        f"updates to {level_text(name, threshold)} {words(name)} (at most {limit:.0f})",
        lambda group: pseudo_values(group.waiting(name, threshold), limit),
        difference,
        -1,
    )


def updates_needed(study: Study, group: Group, threshold: float) -> Interval:
    """Restricted mean of a group's updates to a threshold of the headline measurement."""
    return restricted_interval(
        group.waiting(study.headline, threshold), study.restricted_to(threshold)
    )


def compare(outcome: Outcome, one: Group, other: Group) -> Comparison:
    """Compare two groups."""
    difference = outcome.difference(one, other)
    better = None
    if difference.decided:
        better = one.label if difference.estimate * outcome.sign > 0 else other.label
    a, b = (outcome.sign * np.asarray(outcome.values(group)) for group in (one, other))
    return Comparison(
        one.label,
        other.label,
        outcome.name,
        difference,
        better,
        probability_of_improvement(a, b),
        None if better else seeds_needed(a, b),
    )


def comparisons(study: Study) -> list[Comparison]:
    """Every pair of groups by every outcome."""
    pairs = list(combinations(study.compared, 2))
    return [compare(outcome, *pair) for outcome in outcomes(study) for pair in pairs]


def comparison_table(study: Study) -> Table:
    """Every pair of groups by every outcome."""
    rows: list[dict[str, Cell]] = [
        {
            "outcome": row.outcome,
            "first": row.one,
            "second": row.other,
            "difference": row.difference,
            "better": row.better or "undecided",
            "P(first better)": row.improvement,
            "seeds needed": row.seeds,
        }
        for row in comparisons(study)
    ]
    note = (
        "Difference: first minus second, with a 95 % interval: percentile bootstrap over the runs "
        "for updates, Welch's for the others. P(first better): over all pairs of runs, ties count "
        "half. Seeds needed: per method, for a power of 80 % at 5 % if the true difference is the "
        "one seen. No correction for the number of comparisons."
    )
    return Table("comparisons", "Pairwise comparisons", note, rows)


def group_table(study: Study) -> Table:
    """One row per group."""
    headline, horizon, threshold = study.headline, study.horizon, study.threshold
    waiting, worst = waiting_outcome(study, threshold).name, f"{headline}_worst10"
    rows: list[dict[str, Cell]] = []
    for group in study.groups:
        runs, final = group.runs, _known(group.runs, headline, horizon)
        reached = sum(run.reached for run in group.waiting(headline, threshold))
        needed = updates_needed(study, group, threshold) if group in study.compared else None
        row: dict[str, Cell] = {
            "method": group.label,
            "seeds": len(runs),
            f"reached {level_text(headline, threshold)}": f"{reached} of {len(runs)}",
            waiting: needed,
        }
        for name in study.measurements:
            row[f"{words(name)} after {horizon} updates"] = _mean(_known(runs, name, horizon))
        row[f"IQM of {words(headline)}"] = interquartile_mean(final) if final else None
        if any(worst in run.metrics for run in study.runs):
            row[f"{words(headline)}, worst 10 %"] = _mean(_known(runs, worst, horizon))
        cost: dict[str, Callable[[Run], float]] = {
            "frames (M)": lambda run: run.metrics["frames"][-1] / MILLION,
            "with the curriculum's (M)": lambda run: run.total_frames[-1] / MILLION,
            "evaluations": lambda run: run.metrics["evaluations"][-1],
            "seconds per run": lambda run: run.own_seconds[-1],
        }
        row |= {name: float(np.mean([paid(run) for run in runs])) for name, paid in cost.items()}
        rows.append(row)
    note = (
        f"Updates: mean of min(updates, {study.restricted_to(threshold):.0f}) by Kaplan-Meier, so "
        "that censored runs count; measured every few updates, so never exact. Frames: the "
        "Solver's own, and with all that the curriculum spent. Evaluations: of levels, asked for "
        "by the curriculum. Brackets: 95 % interval."
    )
    return Table("methods", "Methods", note, rows)


def run_table(study: Study) -> Table:
    """One row per run."""
    rows: list[dict[str, Cell]] = []
    for group in study.groups:
        for run in group.runs:
            waiting = run.waiting(study.headline, study.threshold)
            last = {name: float(values[-1]) for name, values in run.metrics.items()}
            rows.append(
                {
                    "method": group.label,
                    "seed": str(run.seed),
                    "folder": run.folder.name,
                    "state": "finished" if run.finished else "unfinished",
                    "updates": run.updates,
                    f"updates to {level_text(study.headline, study.threshold)}": (
                        int(waiting.updates) if waiting.reached else None
                    ),
                    "threshold": (
                        "reached" if waiting.reached else f"censored at {waiting.updates:.0f}"
                    ),
                    **{f"last {words(name)}": last[name] for name in study.measurements},
                    "frames": int(last["frames"]),
                    "the curriculum's frames": int(last["curriculum_frames"]),
                    "evaluations": int(last["evaluations"]),
                    "seconds": float(run.own_seconds[-1]),
                }
            )
    return Table("runs", "Runs", "Measurements are the run's last.", rows)


def tidy_metrics(study: Study) -> tuple[list[str], list[list[Cell]]]:
    """Every evaluation of every run: the numbers behind the figures, for other tools."""
    names = list(dict.fromkeys(name for run in study.runs for name in run.metrics))
    rows: list[list[Cell]] = []
    for group in study.groups:
        for run in group.runs:
            none = np.full(len(run.metrics["updates"]), math.nan)
            columns = [run.metrics.get(name, none) for name in names]
            rows += [[group.label, run.seed, *map(float, row)] for row in np.transpose(columns)]
    return ["method", "seed", *names], rows


def tidy_cycles(study: Study) -> tuple[list[str], list[list[Cell]]]:
    """Every cycle of every curriculum: whatever it recorded, lists as numbers with spaces."""
    found = [(group.label, run) for group in study.groups for run in group.logs]
    names = list(dict.fromkeys(name for _, run in found for cycle in run.cycles for name in cycle))
    names = names[:MOST_COLUMNS]
    rows: list[list[Cell]] = [
        [label, run.seed, *(_cell(cycle.get(name)) for name in names)]
        for label, run in found
        for cycle in run.cycles
    ]
    return ["method", "seed", *names], rows


def _cell(value: Any, depth: int = 0) -> Cell:
    if isinstance(value, str):
        return value[:LONGEST_TEXT]
    if isinstance(value, list) and depth < DEEPEST:
        cells = [_cell(item, depth + 1) for item in value]
        return " ".join(cell if isinstance(cell, str) else f"{cell:.6g}" for cell in cells)
    return records.number(value)


def _known(runs: Sequence[Run], name: str, updates: float) -> list[float]:
    found = [run.at(name, updates) for run in runs if name in run.metrics]
    return [value for value in found if not math.isnan(value)]


def _mean(values: Sequence[float]) -> Interval | None:
    return mean_interval(values) if values else None
