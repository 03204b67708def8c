"""Computes the curves of a study, for the figures and for the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
import pandas as pd

from proposer_rl.report.runs import COST, Run
from proposer_rl.report.studies import Group, Study
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import (
    GAINS,
    PLACE,
    Column,
    Record,
    batch_shares,
    number,
    numbers,
    words,
)

UPDATES = "Solver updates"
# Costs of training besides updates, by their names: of a run, at each of its evaluations.
COSTS: Mapping[str, Callable[[Run], Column]] = {
    "environment frames, millions (all)": lambda run: run.total_frames / 1e6,
    "wall-clock seconds": lambda run: run.own_seconds - run.own_seconds[0],
}
GRID_POINTS = 100
SHARES = np.geomspace(0.01, 1.0, 61)  # of the levels, the worst
MOST = 30  # measures of a kind
OF_REPLICAS: Mapping[str, Callable[[Column], float]] = {"maximum": np.max, "mean": np.mean}
OWN = {
    "entropy": "entropy (nats)",
    "kl_approx": "KL divergence per epoch (nats)",
    "clip_fraction": "share of clipped ratios",
    "explained_variance": "explained variance of the value",
    "reward_sd": "sd of total reward over the replicas",
    "reward_explained": "share of rewards explained by actions",
}
MEASURED, TRAINED = "Measured", "What the Solver trained on"
RECORDED = "The curricula's own numbers"

Value = Callable[[Record], float]  # of a cycle; NaN where it has none


# A number of a method's runs along an axis: a row for each run, indexed by its seed, and a column
# for each place on the axis; NaN where a run has no value.
Series: TypeAlias = pd.DataFrame


class Measure(NamedTuple):
    """A number of every method along one axis or several.

    Attributes:
        kind: the heading that it is listed under.
        name: the title of its axis.
        axes: a function from a method to its series, or None, by the abscissa.
        rate: whether it goes from 0 to 1.
        log: whether the axis is logarithmic.
    """

    kind: str
    name: str
    axes: Mapping[str, Callable[[Group], Series | None]]
    rate: bool = False
    log: bool = False


def every(study: Study) -> list[Measure]:
    """Returns all measures of a study that can be drawn."""
    solver, curricula = [*measured(study).values(), *trained(study)], gains(study)
    return [*solver, *curricula, *own_numbers(study), *worst(study)]


def measured(study: Study) -> dict[str, Measure]:
    """Returns the Solver's measurements against updates and costs, by column of the table."""
    known = dict.fromkeys(name for run in study.runs for name in run.metrics if name not in COST)
    first = [*study.measurements, *(f"{name}_worst10" for name in study.measurements)]
    return {
        name: Measure(
            MEASURED,
            axis_text(name),
            {
                UPDATES: partial(over_updates, name=name),
                **{axis: partial(over_cost, name=name, cost=cost) for axis, cost in COSTS.items()},
            },
            is_rate(name),
        )
        for name in [name for name in dict.fromkeys([*first, *known]) if name in known][:MOST]
    }


def trained(study: Study) -> list[Measure]:
    """Returns the task's statistics of the levels trained on."""
    names = dict.fromkeys(name for run in study.runs for name in run.statistics)
    return [
        Measure(
            TRAINED,
            name.replace("_", " "),
            {UPDATES: partial(over_updates, name=name, table="training")},
            rate=is_rate(name),
        )
        for name in list(names)[:MOST]
    ]


def gains(study: Study) -> list[Measure]:
    """Returns the maximum and the mean of the gains of a cycle's replicas."""
    names = dict.fromkeys(filter(None, map(recorded_gain, study.groups)))
    return [
        _of_cycles(
            f"total gain in {GAINS[name]}, {text} of the replicas",
            partial(of_gains, names=[name], reduce=reduce),
        )
        for name in names
        for text, reduce in OF_REPLICAS.items()
    ]


def own_numbers(study: Study) -> list[Measure]:
    """Returns shares of batches, and all numbers of cycles that are not drawn elsewhere."""
    cycles = [cycle for group in study.groups for run in group.logs for cycle in run.cycles]
    found = {name for c in cycles for name, value in c.items() if not math.isnan(number(value))}
    names = found - PLACE - GAINS.keys()
    texts = {name: text for name, text in OWN.items() if name in names}
    texts |= {name: name.replace("_", " ") for name in sorted(names - texts.keys())}
    arms = list(dict.fromkeys(name for cycle in cycles for name in batch_shares(cycle)))[:MOST]
    own = [_of_cycles(f"share of the batch: {n}", partial(_share, name=n), rate=True) for n in arms]
    own += [
        _of_cycles(text, partial(_value, name=name)) for name, text in list(texts.items())[:MOST]
    ]
    if any(map(recorded_gain, study.groups)):
        ratio = partial(of_gains, names=GAINS, reduce=_ratio)
        own.append(_of_cycles("total gain: mean / sd of replicas", ratio))
    return own


def worst(study: Study) -> list[Measure]:
    """Returns the means over the worst levels at the end, against their share (CVaR)."""
    levels = study.example.task.levels
    return [
        Measure(
            f"Single {levels} at the end",
            f"{axis_text(name)} on the worst share",
            {f"worst share of the {levels}": partial(_worst_series, study=study, name=name)},
            rate=is_rate(name),
            log=True,
        )
        for name in of_levels(study)
    ]


def axis_text(name: str) -> str:
    """Returns the name of an axis for a column, such as "ID success rate"."""
    plain = name.removesuffix("_worst10")
    worst = " on the worst 10 %" if plain != name else ""
    return f"{words(plain)}{' rate' if is_rate(name) else ''}{worst}"


def over_updates(group: Group, name: str, table: str = "metrics") -> Series | None:
    """Returns a column of a run's ``metrics`` or ``training`` against updates, or None.

    Runs have no value at updates at which only others were evaluated.
    """
    tables = {run.seed: getattr(run, table) for run in group.runs}
    return _aligned({s: (own["updates"], own[name]) for s, own in tables.items() if name in own})


def over_cost(group: Group, name: str, cost: Callable[[Run], Column]) -> Series | None:
    """Returns a measurement of a group's runs against a cost; None where no run has it.

    Runs are interpolated, since their evaluations are at different costs.
    """
    runs = [run for run in group.runs if name in run.metrics]
    if not runs:
        return None
    x = np.linspace(0, max(cost(run)[-1] for run in runs), GRID_POINTS)
    rows = [np.interp(x, cost(r), r.metrics[name], left=np.nan, right=np.nan) for r in runs]
    return pd.DataFrame(rows, [run.seed for run in runs], x)


def over_cycles(group: Group, value: Value) -> Series | None:
    """Returns a number of every cycle against updates, a row for each folder's cycles."""
    return _aligned(
        {
            run.seed: ([number(c["updates"]) for c in run.cycles], [value(c) for c in run.cycles])
            for run in group.logs
        }
    )


def _aligned(runs: Mapping[int, tuple[Iterable[float], Iterable[float]]]) -> Series | None:
    """Returns the series of runs whose places and values are given; None without a run."""
    rows = {seed: dict(zip(*own, strict=True)) for seed, own in runs.items()}
    return pd.DataFrame(rows, dtype=float).sort_index().T if rows else None


def worst_means(scores: Column, shares: Column) -> Column:
    """Returns means over the worst shares of the levels, the conditional value at risk (CVaR).

    A level counts in part where the share is not a whole number of levels (Acerbi & Tasche, Journal
    of Banking & Finance 26, 2002, definition 3).

    Args:
        scores: [runs, levels].
        shares: above 0 and at most 1, [n].

    Returns:
        Float [runs, n].
    """
    levels = scores.shape[1]
    sums = np.cumsum(np.sort(scores, 1), 1)  # [runs, levels]
    counts = np.arange(levels + 1)
    whole = [np.interp(shares * levels, counts, [0.0, *row]) for row in sums]
    return np.array(whole) / (shares * levels)


def of_levels(study: Study) -> list[str]:
    """Returns the measurements that some run has for every single level."""
    groups = study.groups
    return [n for n in study.measurements if any(study.scores(g, n) is not None for g in groups)]


def recorded_gain(group: Group) -> str | None:
    """Returns the name of the replicas' gain that a group has recorded; None without one."""
    cycles = [cycle for run in group.logs for cycle in run.cycles]
    every = (name for name in GAINS if any(numbers(c.get(name)) is not None for c in cycles))
    return next(every, None)


def of_gains(cycle: Record, names: Iterable[str], reduce: Callable[[Column], float]) -> float:
    """Returns a statistic of the first of the named gains that a cycle has; NaN without any."""
    found = [values for name in names if (values := numbers(cycle.get(name))) is not None]
    return float(reduce(found[0])) if found else np.nan


def _of_cycles(name: str, value: Value, *, rate: bool = False) -> Measure:
    return Measure(RECORDED, name, {UPDATES: partial(over_cycles, value=value)}, rate)


def _worst_series(group: Group, study: Study, name: str) -> Series | None:
    scores = study.scores(group, name)
    if scores is None:
        return None
    seeds = [run.seed for run in study.tellers(group, name)]
    return pd.DataFrame(worst_means(scores, SHARES), seeds, SHARES)


def _value(cycle: Record, name: str) -> float:
    return number(cycle.get(name))


def _share(cycle: Record, name: str) -> float:
    return batch_shares(cycle).get(name, math.nan)


def _ratio(values: Column) -> float:
    spread = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    return float(values.mean()) / spread if spread else np.nan
