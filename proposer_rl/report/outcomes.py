"""What came out: one row per run, per group, and per pair of groups."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from proposer_rl.report import records
from proposer_rl.report.records import LONGEST_TEXT, level_text, words
from proposer_rl.report.runs import COST, Run
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
from proposer_rl.report.tables import Cell, Columns, Table, adaptive, number

MILLION = 1e6
MOST_COLUMNS = 200


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
            found = [value(run) for run in group.runs]
            return [one for one in found if not math.isnan(one)]

        return Outcome(name, values, lambda a, b: mean_difference(values(a), values(b)), 1)

    return [
        waiting_outcome(study, study.threshold),
        plain(
            f"{words(headline)}, mean over {horizon} updates",
            lambda run: run.mean_until(headline, horizon),
        ),
        *(
            plain(f"{words(name)} after {horizon} updates", partial(_at, name, horizon))
            for name in study.measurements
        ),
    ]


def waiting_outcome(study: Study, threshold: float) -> Outcome:
    """Restricted updates to a threshold of the headline measurement."""
    headline, limit = study.headline, study.restricted_to(threshold)

    return Outcome(
        f"updates to {level_text(headline, threshold)} {words(headline)} (at most {limit:.0f})",
        lambda group: pseudo_values(group.waiting(headline, threshold), limit),
        lambda a, b: restricted_difference(
            a.waiting(headline, threshold), b.waiting(headline, threshold), limit
        ),
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


def comparisons(study: Study) -> Iterator[Comparison]:
    """Every pair of groups by every outcome."""
    for outcome in outcomes(study):
        for one, other in combinations(study.compared, 2):
            yield compare(outcome, one, other)


def comparison_table(rows: Sequence[Comparison]) -> Table:
    """Pairs of groups by every outcome."""
    return Table(
        "comparisons",
        "Pairwise comparisons",
        "Difference: first minus second, with a 95 % interval: percentile bootstrap over the runs "
        "for updates, Welch's for the others. P(first better): over all pairs of runs, ties count "
        "half. Seeds needed: per method, for a power of 80 % at 5 % if the true difference is the "
        "one seen. No correction for the number of comparisons.",
        {
            "outcome": str,
            "first": str,
            "second": str,
            "difference": adaptive,
            "better": str,
            "P(first better)": number(2),
            "seeds needed": number(0),
        },
        [
            [
                row.outcome,
                row.one,
                row.other,
                row.difference,
                row.better or "undecided",
                row.improvement,
                row.seeds,
            ]
            for row in rows
        ],
    )


def group_table(study: Study) -> Table:
    """One row per group."""
    headline, horizon, threshold = study.headline, study.horizon, study.threshold
    worst = f"{headline}_worst10"
    with_worst = any(worst in run.metrics for run in study.runs)
    columns: Columns = {
        "method": str,
        "seeds": number(0),
        f"reached {level_text(headline, threshold)}": str,
        waiting_outcome(study, threshold).name: number(0),
        **{f"{words(name)} after {horizon} updates": number(3) for name in study.measurements},
        f"IQM of {words(headline)}": number(3),
        **({f"{words(headline)}, worst 10 % of levels": number(3)} if with_worst else {}),
        "frames (M)": number(2),
        "with the curriculum's (M)": number(2),
        "evaluations": number(0),
        "seconds per run": number(0),
    }
    rows: list[list[Cell]] = []
    for group in study.groups:
        runs = group.runs
        final = _known(runs, headline, horizon)
        reached = sum(run.reached for run in group.waiting(headline, threshold))
        costs = [
            (own / MILLION, whole / MILLION, evaluations, seconds)
            for run in runs
            for own, whole, evaluations, seconds in [
                (
                    run.metrics["frames"][-1],
                    run.total_frames[-1],
                    run.metrics["evaluations"][-1],
                    run.own_seconds[-1],
                )
            ]
        ]
        rows.append(
            [
                group.label,
                len(runs),
                f"{reached} of {len(runs)}",
                updates_needed(study, group, threshold) if group in study.compared else None,
                *(_mean(_known(runs, name, horizon)) for name in study.measurements),
                interquartile_mean(final) if final else None,
                *([_mean(_known(runs, worst, horizon))] if with_worst else []),
                *map(float, np.mean(costs, 0)),
            ]
        )
    note = (
        f"Updates: mean of min(updates, {study.restricted_to(threshold):.0f}) by Kaplan-Meier, so "
        "that censored runs count; measured every few updates, so never exact. Frames: the "
        "Solver's own, and with all that the curriculum spent. Evaluations: of levels, asked for "
        "by the curriculum. Brackets: 95 % interval."
    )
    return Table("methods", "Methods", note, columns, rows)


def run_table(study: Study) -> Table:
    """One row per run."""
    measured = study.measurements
    rows: list[list[Cell]] = []
    for group in study.groups:
        for run, waiting in zip(
            group.runs, group.waiting(study.headline, study.threshold), strict=True
        ):
            rows.append(
                [
                    group.label,
                    run.seed,
                    run.folder.name,
                    "finished" if run.finished else "unfinished",
                    run.updates,
                    waiting.updates if waiting.reached else None,
                    "reached" if waiting.reached else f"censored at {waiting.updates:.0f}",
                    *(float(run.metrics[name][-1]) for name in (*measured, *COST[1:4])),
                    float(run.own_seconds[-1]),
                ]
            )
    columns: Columns = {
        "method": str,
        "seed": str,
        "folder": str,
        "state": str,
        "updates": number(0),
        f"updates to {level_text(study.headline, study.threshold)}": number(0),
        "threshold": str,
        **{f"last {words(name)}": number(3) for name in measured},
        "frames": number(0),
        "the curriculum's frames": number(0),
        "evaluations": number(0),
        "seconds": number(0),
    }
    return Table("runs", "Runs", "Measurements are the run's last.", columns, rows)


def tidy_metrics(study: Study) -> tuple[list[str], list[list[Cell]]]:
    """Every evaluation of every run: the numbers behind the figures, for other tools."""
    names = list(dict.fromkeys(name for run in study.runs for name in run.metrics))
    rows: list[list[Cell]] = []
    for group in study.groups:
        for run in group.runs:
            for i in range(len(run.metrics["updates"])):
                values = [
                    float(run.metrics[name][i]) if name in run.metrics else math.nan
                    for name in names
                ]
                rows.append([group.label, run.seed, *values])
    return ["method", "seed", *names], rows


def tidy_cycles(study: Study) -> tuple[list[str], list[list[Cell]]]:
    """Every cycle of every curriculum: whatever it recorded, lists as numbers with spaces."""
    found = [
        (group.label, run.seed, cycle)
        for group in study.groups
        for run in group.logs
        for cycle in run.cycles
    ]
    names = list(dict.fromkeys(name for *_, cycle in found for name in cycle))[:MOST_COLUMNS]
    rows: list[list[Cell]] = [
        [label, seed, *(_cell(cycle.get(name)) for name in names)] for label, seed, cycle in found
    ]
    return ["method", "seed", *names], rows


def _cell(value: Any) -> Cell:
    if isinstance(value, str):
        return value[:LONGEST_TEXT]
    return " ".join(_flat(value)) if isinstance(value, list) else records.number(value)


def _flat(value: Any) -> Iterator[str]:
    if isinstance(value, list):
        for item in value:
            yield from _flat(item)
    else:
        yield f"{records.number(value):.6g}"


def _at(name: str, updates: float, run: Run) -> float:
    return run.at(name, updates)


def _known(runs: Sequence[Run], name: str, updates: float) -> list[float]:
    found = [run.at(name, updates) for run in runs if name in run.metrics]
    return [value for value in found if not math.isnan(value)]


def _mean(values: Sequence[float]) -> Interval | None:
    return mean_interval(values) if values else None
