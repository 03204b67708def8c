"""Prepares the numbers of the page's charts and its slider as JSON."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image

from proposer_rl.report import measures
from proposer_rl.report.comparisons import Outcome, outcomes
from proposer_rl.report.measures import Measure, Series, axis_text
from proposer_rl.report.runs import Run, share_map
from proposer_rl.report.statistics import median_of
from proposer_rl.report.studies import Group, Study
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import LevelRecord, number, pixels

Json = Any
DIGITS = 5
LEVELS = 4  # of a batch
SIDE = 160  # pixels of a picture, at most
# How many stages of a method are shown: as many as fit.
STAGES = (40, 20, 10, 5)
MOST_BYTES = 2**20  # of all pictures of a study


def charts(study: Study) -> dict[str, Json]:
    """Returns the numbers of all charts of a study, ready for JSON.

    Returns:
        ``methods``: labels and seeds. ``axes``: the possible abscissas. ``measures``: by axis the
        median and interval of every method, with the ``rows`` and ``seeds`` of its runs, or null.
        ``outcomes``: means, and the values of runs. ``baseline``: the method's number.
        ``headline``: its name, and whether it is a rate. ``stages``: of the slider, or null.
    """
    return {
        "methods": [{"label": group.label, "seeds": group.seeds} for group in study.groups],
        "axes": [measures.UPDATES, *measures.COSTS],
        "measures": [_measure(study, each) for each in measures.every(study)],
        "outcomes": _outcomes(study),
        "baseline": [group.label for group in study.groups].index(study.baseline.label),
        "headline": {"name": axis_text(study.headline), "rate": is_rate(study.headline)},
        "stages": _stages(study),
    }


def plain(values: Iterable[float]) -> list[float | None]:
    """Returns numbers with five significant digits, and None for those that are not finite."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in map(float, values)]


def _measure(study: Study, measure: Measure) -> Json:
    return {
        "kind": measure.kind,
        "name": measure.name,
        "axes": {axis: [_series(of(g)) for g in study.groups] for axis, of in measure.axes.items()},
        "rate": measure.rate,
    }


def _series(series: Series | None) -> Json:
    if series is None:
        return None
    median, low, high = median_of(series)
    return {
        "x": plain(series.columns),
        "median": plain(median),
        "whole": series.notna().all().tolist(),
        "low": plain(low),
        "high": plain(high),
        "seeds": series.index.tolist(),
        "rows": [plain(row) for row in series.to_numpy()],
    }


def _outcomes(study: Study) -> list[Json]:
    """Returns each outcome with the methods' means over seeds and the values of their runs."""
    return [
        {
            "name": outcome.name,
            "sign": outcome.sign,
            "methods": [
                {
                    "mean": plain(_mean(study, group, outcome)),
                    "values": plain(outcome.value(run.until(study.horizon)) for run in group.runs),
                }
                for group in study.groups
            ],
        }
        for outcome in outcomes(study)
    ]


def _mean(study: Study, group: Group, outcome: Outcome) -> Sequence[float]:
    """Returns the mean of the runs of full length; empty without one."""
    whole = study.group(group.label)
    values = outcome.values(whole) if whole else []
    return [float(np.mean(values))] if values else []


def _stages(study: Study) -> dict[str, Json] | None:
    """Returns the stages of the slider for one run of each method, the first with recorded levels.

    If none of a method's runs has any, it is the first that recorded proposals.

    Returns:
        ``axes``: names and values of the space of levels, at most two. ``pictures``: each once, a
        PNG in base64. ``methods``: for every method null or the ``seed``, the ``curve`` of its
        headline and the ``stages``: updates, ``levels`` (the number of a picture, or lines of
        text) and ``map`` (rows of shares of proposals, as recorded last or else first) or null.
        ``first``: the number of the method to begin with. None where no run recorded either, or
        the pictures are too large for a page.
    """
    like = study.example
    runs = [
        next((run for run in group.runs if run.samples), None)
        or next(
            (run for run in group.runs if any(like.shares(c) is not None for c in run.cycles)),
            None,
        )
        for group in study.groups
    ]
    for most in STAGES:
        pictures: dict[str, int] = {}
        methods = [None if run is None else _method(run, study, most, pictures) for run in runs]
        if sum(map(len, pictures)) <= MOST_BYTES:
            break
    else:
        return None
    shown = {number: method for number, method in enumerate(methods) if method is not None}
    if not shown:
        return None
    proposed = [number for number, method in shown.items() if method["stages"][-1]["map"]]
    axes = [
        {"name": name, "values": [v if isinstance(v, str) else plain([v])[0] for v in values]}
        for name, values in list(like.task.space.items())[:2]
    ]
    return {
        "axes": axes,
        "pictures": list(pictures),
        "methods": methods,
        "first": next(iter([*proposed, *shown])),
    }


def _method(run: Run, study: Study, most: int, pictures: dict[str, int]) -> dict[str, Json]:
    moments: list[tuple[int, Sequence[LevelRecord]]] = [(s.updates, s.levels) for s in run.samples]
    if not moments:
        moments = [
            (updates, ()) for updates in sorted({int(number(c["updates"])) for c in run.cycles})
        ]
    last = len(moments) - 1
    chosen = np.unique(np.linspace(0, last, min(most, len(moments))).round()).astype(int)
    curve = (run.metrics["updates"], run.metrics[study.headline])
    return {
        "seed": run.seed,
        "curve": [plain(values) for values in curve],
        "stages": [
            {
                "updates": moments[i][0],
                "levels": [_level(level, pictures) for level in moments[i][1][:LEVELS]],
                "map": _map(run, study.example, moments[i][0]),
            }
            for i in chosen
        ],
    }


def _level(level: LevelRecord, pictures: dict[str, int]) -> Json:
    small = _small(level.picture)
    return level.text if small is None else pictures.setdefault(small, len(pictures))


@lru_cache(4 * LEVELS * STAGES[0])
def _small(stored: str | None) -> str | None:
    """Returns a picture as PNG in base64, scaled down for display; None where there is none.

    Results are kept, since fewer stages are tried with the same pictures if all do not fit.
    """
    if stored is None:
        return None
    image, file = Image.fromarray(pixels(stored)), io.BytesIO()
    image.thumbnail((SIDE, SIDE))
    image.save(file, format="PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def _map(run: Run, like: Run, updates: int) -> Json:
    """Returns the shares of proposals recorded last up to that update, or else first; or None."""
    every = [(number(cycle["updates"]), like.shares(cycle)) for cycle in run.cycles]
    known = [(at, shares) for at, shares in every if shares is not None]
    shown = [shares for at, shares in known if at <= updates] or [s for _, s in known[:1]]
    return [plain(row) for row in share_map(shown[-1])] if shown else None
