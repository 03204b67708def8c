"""The numbers of the page's charts as JSON: those of the figures, with every single run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

from proposer_rl.report.comparisons import Outcome, outcomes, updates_needed, waiting_outcome
from proposer_rl.report.measures import (
    COSTS,
    UPDATES,
    Measure,
    Series,
    axis_text,
    band,
    gains,
    level_means,
    measured,
    of_levels,
    own_numbers,
    trained,
    worst,
)
from proposer_rl.report.statistics import mean_interval
from proposer_rl.report.studies import Group, Study
from proposer_rl.runs.columns import is_rate

Json = Any
DIGITS = 5
DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"}


def charts(study: Study) -> dict[str, Json]:
    """All that the page draws of a study, but for what :mod:`~proposer_rl.report.stages` has.

    Returns:
        ``methods``: each with its look and seeds. ``axes``: what can be on the abscissa.
        ``measures``: each by axis with mean and interval of every method, and with ``rows`` of its
        runs and their ``seeds``; null where there is none.
        ``outcomes``: each with an estimate and the runs' values. ``levels``: of every measurement
        that two methods have for single levels what each reaches there, null without records.
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
        "measures": [
            _measure(study, each)
            for each in (
                *measured(study).values(),
                *trained(study),
                *gains(study),
                *own_numbers(study),
                *worst(study),
            )
        ],
        "outcomes": _outcomes(study),
        "levels": _levels(study),
        "baseline": [group.label for group in study.groups].index(study.baseline.label),
        "headline": {"name": axis_text(study.headline), "rate": is_rate(study.headline)},
    }


def plain(values: Iterable[float]) -> list[float | None]:
    """Numbers as JSON has them, with five significant digits; null for what is none."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in map(float, values)]


def _measure(study: Study, measure: Measure) -> Json:
    return {
        "kind": measure.kind,
        "name": measure.name,
        "axes": {axis: [_series(of(g)) for g in study.groups] for axis, of in measure.axes.items()},
        "rate": measure.rate,
        "log": measure.log,
    }


def _levels(study: Study) -> list[Json]:
    """What the methods reach on every single level at the end, mean over seeds."""
    every = {
        name: [level_means(study, group, name) for group in study.groups]
        for name in of_levels(study)
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


def _series(series: Series | None) -> Json:
    if series is None:
        return None
    found = band(series.rows)
    return {
        "x": plain(series.x),
        "mean": plain(found.mean),
        "whole": found.whole.tolist(),
        "low": plain(found.low),
        "high": plain(found.high),
        "seeds": [run.seed for run in series.runs],
        "rows": [plain(row) for row in series.rows],
    }


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
