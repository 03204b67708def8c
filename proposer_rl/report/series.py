"""What was measured along training, by method: the numbers behind every curve, drawn or not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from proposer_rl.report.records import Column, Record, number
from proposer_rl.report.runs import Run
from proposer_rl.report.statistics import mean_interval
from proposer_rl.report.studies import Group

GRID_POINTS = 100
# What training cost beside updates: in words, and of a run at each of its evaluations.
COSTS: Mapping[str, Callable[[Run], Column]] = {
    "environment frames, millions (all)": lambda run: run.total_frames / 1e6,
    "wall-clock seconds": lambda run: run.own_seconds - run.own_seconds[0],
}


class Series(NamedTuple):
    """A number of a method's runs along an axis.

    Attributes:
        x: places on the axis, [n].
        rows: of each run, [runs, n], NaN where it has none.
        runs: whose rows these are.
    """

    x: Column
    rows: Column
    runs: Sequence[Run]


class Band(NamedTuple):
    """Mean and interval of the runs at each place, [n]; NaN where there is none.

    Attributes:
        mean: over the runs that have a value.
        whole: whether all runs have one, bool [n].
        low, high: ends of the 95 % interval, where all runs have a value.
    """

    mean: Column
    whole: NDArray[np.bool_]
    low: Column
    high: Column


def over_updates(group: Group, name: str, table: str = "metrics") -> Series | None:
    """A column of the runs' ``metrics`` or ``training`` against updates; None where no run has it.

    Runs that were evaluated at different updates have no value at those of the others.
    """
    runs = [run for run in group.runs if name in getattr(run, table)]
    if not runs:
        return None
    columns = [getattr(run, table) for run in runs]
    x = np.unique(np.concatenate([own["updates"] for own in columns]))
    rows = np.full((len(runs), len(x)), np.nan)
    for row, own in zip(rows, columns, strict=True):
        row[np.searchsorted(x, own["updates"])] = own[name]
    return Series(x, rows, runs)


def over_cost(group: Group, name: str, cost: Callable[[Run], Column]) -> Series | None:
    """A measurement against what was paid for it; None where no run has it.

    Runs stand at different costs when they are measured, so they are interpolated in between.
    """
    runs = [run for run in group.runs if name in run.metrics]
    if not runs:
        return None
    x = np.linspace(0, max(cost(run)[-1] for run in runs), GRID_POINTS)
    rows = [np.interp(x, cost(r), r.metrics[name], left=np.nan, right=np.nan) for r in runs]
    return Series(x, np.array(rows), runs)


def over_cycles(group: Group, value: Callable[[Record], float]) -> Series:
    """A number of every cycle against updates, for each of the group's records of cycles."""
    runs = group.logs
    x = np.unique([number(cycle["updates"]) for run in runs for cycle in run.cycles])
    rows = np.full((len(runs), len(x)), np.nan)
    for row, run in zip(rows, runs, strict=True):
        for cycle in run.cycles:
            row[np.searchsorted(x, number(cycle["updates"]))] = value(cycle)
    return Series(x, rows, runs)


def band(rows: Column) -> Band:
    """Mean and interval over runs.

    Args:
        rows: [runs, n], NaN where a run has no value.
    """
    mean = np.ma.masked_invalid(rows).mean(0).filled(np.nan)
    whole = np.all(~np.isnan(rows), axis=0)
    low, high = np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    if len(rows) > 1 and whole.any():
        _, low[whole], high[whole] = np.array([mean_interval(v) for v in rows.T[whole]]).T
    return Band(mean, whole, low, high)
