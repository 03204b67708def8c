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
from proposer_rl.runs.records import Column, number, words

UPDATES = "Solver updates"
# Costs of training besides updates, by their names: of a run, at each of its evaluations.
COSTS: Mapping[str, Callable[[Run], Column]] = {
    "environment frames, millions (all)": lambda run: run.total_frames / 1e6,
    "wall-clock seconds": lambda run: run.own_seconds - run.own_seconds[0],
}
GRID_POINTS = 100
MOST = 30  # measures of a kind
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
    """

    kind: str
    name: str
    axes: Mapping[str, Callable[[Group], Series | None]]
    rate: bool = False


def every(study: Study) -> list[Measure]:
    """Returns all measures of a study that can be drawn."""
    return [*measured(study).values(), *trained(study), *own_numbers(study)]


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


def own_numbers(study: Study) -> list[Measure]:
    """Returns the numbers that curricula recorded of their cycles; of a list maximum and mean."""
    runs = (run for group in study.groups for run in group.logs)
    names = dict.fromkeys(name for run in runs for cycle in run.told for name in cycle)
    return [
        Measure(
            RECORDED,
            OWN.get(name, name.replace("_", " ")),
            {UPDATES: partial(over_cycles, name=name)},
            rate=name.startswith("shares/"),
        )
        for name in list(names)[:MOST]
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


def over_cycles(group: Group, name: str) -> Series | None:
    """Returns a number of every cycle against updates, a row for each folder's cycles."""
    return _aligned(
        {
            run.seed: (
                [number(cycle["updates"]) for cycle in run.cycles],
                [told.get(name, math.nan) for told in run.told],
            )
            for run in group.logs
        }
    )


def _aligned(runs: Mapping[int, tuple[Iterable[float], Iterable[float]]]) -> Series | None:
    """Returns the series of runs whose places and values are given; None without a run."""
    rows = {seed: dict(zip(*own, strict=True)) for seed, own in runs.items()}
    return pd.DataFrame(rows, dtype=float).sort_index().T if rows else None
