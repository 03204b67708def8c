"""The numbers of the page's charts as JSON: those of the figures, with every single run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from proposer_rl.report.comparisons import Outcome, outcomes, updates_needed, waiting_outcome
from proposer_rl.report.curves import axis_text
from proposer_rl.report.proposals import gain_numbers, own_numbers
from proposer_rl.report.records import Column
from proposer_rl.report.runs import COST, Run
from proposer_rl.report.series import COSTS, Series, band, over_cost, over_cycles
from proposer_rl.report.series import over_updates as against_updates
from proposer_rl.report.single_levels import level_means, told, worst_series
from proposer_rl.report.statistics import mean_interval
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import UPDATES
from proposer_rl.runs.columns import is_rate

Json = Any
DIGITS = 5
MOST_MEASURES = 30  # of a kind
DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}


def charts(study: Study) -> dict[str, Json]:
    """All that the page draws of a study, but for what :mod:`~proposer_rl.report.stages` has.

    Returns:
        ``methods``: each with its look and seeds. ``axes``: what can be on the abscissa.
        ``places``: of every method's runs where they were evaluated, by axis. ``measures``: each
        by axis with mean and interval of every method, and with ``rows`` of its runs, at their
        places or, where they are another table's, at the means' own; null where there is none.
        ``outcomes``: each with an estimate and the runs' values. ``levels``: of every measurement
        that two methods tell of single levels what each reaches there, null where it does not tell.
        ``baseline``: the method's number. ``headline``: its name, and whether it is a rate.
    """
    return {
        "methods": [
            {
                "label": group.label,
                "colour": group.look.colour,
                "dash": DASHES[group.look.dash],
                "seeds": group.seeds,
            }
            for group in study.groups
        ],
        "axes": [UPDATES, *COSTS],
        "places": [[_places(run) for run in group.runs] for group in study.groups],
        "measures": [*_measured(study), *_trained(study), *_recorded(study), *_single(study)],
        "outcomes": _outcomes(study),
        "levels": _levels(study),
        "baseline": [group.label for group in study.groups].index(study.baseline.label),
        "headline": {"name": axis_text(study.headline), "rate": is_rate(study.headline)},
    }


def plain(values: Iterable[float]) -> list[float | None]:
    """Numbers as JSON has them, with five significant digits; null for what is none."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in map(float, values)]


def _places(run: Run) -> Json:
    costs = {axis: plain(cost(run)) for axis, cost in COSTS.items()}
    return {UPDATES: plain(run.metrics["updates"]), **costs}


def _measured(study: Study) -> list[Json]:
    """The measurements, against updates and every cost."""
    first = [*study.measurements, *(f"{name}_worst10" for name in study.measurements)]
    every = dict.fromkeys([*first, *(name for run in study.runs for name in run.metrics)])
    measures = []
    for name in [n for n in every if n not in COST and _has(study, n)][:MOST_MEASURES]:
        axes = {UPDATES: [against_updates(group, name) for group in study.groups]}
        for axis, cost in COSTS.items():
            axes[axis] = [over_cost(group, name, cost) for group in study.groups]
        rows = [[_row(run.metrics.get(name)) for run in group.runs] for group in study.groups]
        measures.append(_measure("Measured", axis_text(name), axes, rows, rate=is_rate(name)))
    return measures


def _trained(study: Study) -> list[Json]:
    """The task's statistics of the batches."""
    names = dict.fromkeys(name for run in study.runs for name in run.statistics)
    kind = "What the Solver trained on"
    return [
        _on_one_axis(
            kind,
            name.replace("_", " "),
            UPDATES,
            [against_updates(group, name, "training") for group in study.groups],
            study,
            rate=is_rate(name),
        )
        for name in list(names)[:MOST_MEASURES]
    ]


def _recorded(study: Study) -> list[Json]:
    """The curricula's own numbers, and the gains of the copies."""
    values = {**gain_numbers(study), **own_numbers(study)}
    kind = "The curricula's own numbers"
    return [
        _on_one_axis(
            kind,
            name,
            UPDATES,
            [over_cycles(group, value) if group.logs else None for group in study.groups],
            study,
        )
        for name, value in list(values.items())[:MOST_MEASURES]
    ]


def _single(study: Study) -> list[Json]:
    """The mean over the worst levels against their share."""
    levels = study.example.task.levels
    return [
        _on_one_axis(
            f"Single {levels} at the end",
            f"{axis_text(name)} on the worst share",
            f"worst share of the {levels}",
            [worst_series(study, group, name) for group in study.groups],
            study,
            rate=is_rate(name),
            log=True,
        )
        for name in told(study)
    ]


def _levels(study: Study) -> list[Json]:
    """What the methods reach on every single level at the end, mean over seeds."""
    every = {
        name: [level_means(study, group, name) for group in study.groups] for name in told(study)
    }
    return [
        {
            "name": axis_text(name),
            "rate": is_rate(name),
            "methods": [None if one is None else plain(one) for one in means],
        }
        for name, means in every.items()
        if sum(one is not None for one in means) > 1
    ]


def _on_one_axis(
    kind: str,
    name: str,
    axis: str,
    series: Sequence[Series | None],
    study: Study,
    **limits: bool,
) -> Json:
    rows = [
        [_row(_of_run(found, run)) for run in group.runs]
        for group, found in zip(study.groups, series, strict=True)
    ]
    return _measure(kind, name, {axis: series}, rows, own=True, **limits)


def _measure(
    kind: str,
    name: str,
    axes: Mapping[str, Sequence[Series | None]],
    rows: Json,
    **limits: bool,
) -> Json:
    drawn = {axis: [_means(one) for one in series] for axis, series in axes.items()}
    return {"kind": kind, "name": name, "axes": drawn, "rows": rows, **limits}


def _means(series: Series | None) -> Json:
    if series is None:
        return None
    found = band(series.rows)
    return {
        "x": plain(series.x),
        "mean": plain(found.mean),
        "whole": found.whole.tolist(),
        "low": plain(found.low),
        "high": plain(found.high),
    }


def _of_run(series: Series | None, run: Run) -> Column | None:
    rows = () if series is None else zip(series.runs, series.rows, strict=True)
    return next((row for one, row in rows if one is run), None)


def _row(values: Column | None) -> Json:
    return None if values is None else plain(values)


def _has(study: Study, name: str) -> bool:
    return any(name in run.metrics for run in study.runs)


def _outcomes(study: Study) -> list[Json]:
    """What the methods are compared by."""
    return [
        {
            "name": outcome.name,
            "sign": outcome.sign,
            "methods": [
                {
                    "estimate": plain(_estimate(study, study.group(group.label), outcome)),
                    "values": plain(outcome.value(run.until(study.horizon)) for run in group.runs),
                }
                for group in study.groups
            ],
        }
        for outcome in outcomes(study)
    ]


def _estimate(study: Study, group: Group | None, outcome: Outcome) -> Sequence[float]:
    """Estimate and interval; empty without a run of full length."""
    if group is None:
        return ()
    if outcome.name == waiting_outcome(study).name:
        return updates_needed(study, group) or ()
    values = outcome.values(group)
    return mean_interval(values) if values else ()
