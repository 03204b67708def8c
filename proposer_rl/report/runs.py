"""A run as a report sees it, which is one seed of a folder; and the tidy tables of runs.

Reports and studies have the same tables. The folder of a study has ``runs.csv.xz``, with a row for
each run whose settings and facts are JSON, and the tables ``metrics``, ``training``, ``cycles`` and
``levels`` with a row for each evaluation, cycle or level. Cells of ``cycles`` are JSON, so that
lists stay lists. Every number is written so that it reads back bit for bit.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from proposer_rl.runs.folder import SLACK
from proposer_rl.runs.records import (
    Column,
    Record,
    SampleRecord,
    TaskFacts,
    encoded,
    flat,
    number,
)

COST = ("updates", "frames", "curriculum_frames", "evaluations", "seconds")
# Columns of training.csv that are PPO's, besides its losses; the others are the task's.
OF_PPO = {"entropy", "kl_approx", "clip_fraction", "explained_variance", "grad_norm"}
# Entries of a cycle's record that are not the curriculum's own.
PLACE = {"cycle", "updates", "seed", "curriculum_frames", "evaluations", "histogram"}
_STUDENT = re.compile(r"lifetime_(\d{1,9})")
STUDY = "runs.csv.xz"  # a folder with this file is a study
NAMES = ("metrics", "training", "cycles", "levels")


@dataclass(frozen=True)
class Run:
    """One seed of one run's folder.

    Attributes:
        folder: its folder.
        seed: its seed.
        shared_by: seeds that were trained side by side in the folder's process.
        config: the settings, as in ``config.json``.
        facts: versions, device, command and length, from ``run.json`` and ``summary.json``.
        task: the description of the task in ``run.json``.
        finished: whether it reached the end of its schedule.
        metrics, training: the tables, float64, a row for each evaluation.
        cycles: what the curriculum recorded, one per cycle; every entry but updates is optional.
        samples: recorded levels, one record per evaluation.
        levels: results on every level at the end, [levels], by the measurement's column.
    """

    folder: Path
    seed: int
    shared_by: int
    config: Mapping[str, Any]
    facts: Mapping[str, Any]
    task: TaskFacts
    finished: bool
    metrics: pd.DataFrame
    training: pd.DataFrame
    cycles: Sequence[Record]
    samples: Sequence[SampleRecord]
    levels: Mapping[str, Column] = field(default_factory=dict)

    @property
    def method(self) -> str:
        """Name of the method."""
        return str(self.config["method"])

    @property
    def ablation(self) -> str:
        """Name of the ablation, ``none`` without one."""
        return str(self.config.get("ablation", "none"))

    @property
    def student(self) -> int | None:
        """The number of this Solver among those of one Proposer, from 0; None for a lone one."""
        found = _STUDENT.fullmatch(self.folder.name)
        return int(found[1]) if found else None

    @property
    def headline(self) -> str:
        """The measurement by which runs are compared."""
        return str(self.config["schedule"]["headline"])

    @property
    def measurements(self) -> list[str]:
        """A column for each distribution measured on: success or, where that is none, return."""
        columns = ((f"{name}_success", f"{name}_return") for name in self.task.distributions)
        found = ([name for name in pair if name in self.metrics] for pair in columns)
        return [names[0] for names in found if names]

    @property
    def statistics(self) -> list[str]:
        """Columns of the training's table that are the task's statistics."""
        own = {"updates", *OF_PPO}
        return [n for n in self.training if n not in own and not n.startswith("loss_")]

    @property
    def updates(self) -> int:
        """Updates of the Solver at the last evaluation."""
        return int(self.last("updates"))

    @property
    def planned(self) -> int | None:
        """The planned number of updates; None where the folder does not say."""
        value: int | None = self.facts.get("planned_updates", self.facts.get("updates"))
        return value

    @cached_property
    def columns(self) -> Mapping[str, Column]:
        """The columns of the measurements: statistics over many pairs read them often."""
        return {name: column.to_numpy() for name, column in self.metrics.items()}

    @cached_property
    def total_frames(self) -> Column:
        """Environment frames at each evaluation, including those of the curriculum."""
        return self.columns["frames"] + self.columns["curriculum_frames"]

    @cached_property
    def own_seconds(self) -> Column:
        """Wall seconds at each evaluation; an even share where seeds were trained together."""
        return self.columns["seconds"] / self.shared_by

    @cached_property
    def told(self) -> Sequence[Mapping[str, float]]:
        """The curriculum's own numbers in each cycle."""
        own = ({k: v for k, v in cycle.items() if k not in PLACE} for cycle in self.cycles)
        return [flat(cycle) for cycle in own]

    def last(self, name: str) -> float:
        """Returns the last value of a column of the measurements."""
        return float(self.columns[name][-1])

    def until(self, horizon: int) -> Run:
        """Returns the run as it was after so many updates, linear between evaluations.

        Records of its end are left out. A shorter run stays as it is.
        """
        if self.updates <= horizon:
            return self
        x = self.metrics["updates"]
        metrics = {
            name: np.append(column[x < horizon], np.interp(horizon, x, column))
            for name, column in self.metrics.items()
        }
        return replace(
            self,
            metrics=pd.DataFrame(metrics),
            training=self.training[self.training.get("updates", pd.Series()) <= horizon],
            cycles=[cycle for cycle in self.cycles if number(cycle["updates"]) < horizon],
            samples=[sample for sample in self.samples if sample.updates <= horizon],
            levels={},
        )

    def reached(self, measurement: str, threshold: float) -> float:
        """Returns updates until a measurement first reached a threshold; NaN if it never did."""
        found = self.columns["updates"][self.columns[measurement] >= threshold - SLACK]
        return float(found.min()) if found.size else math.nan

    def waited(self, measurement: str, threshold: float, horizon: float) -> float:
        """Returns updates until a threshold, cut at a horizon; NaN for a shorter run.

        A shorter run has NaN even if it reached the threshold, since otherwise of the short runs
        only the fast ones would count.
        """
        if self.updates < horizon:
            return math.nan
        return float(np.fmin(self.reached(measurement, threshold), horizon))

    def at(self, measurement: str, updates: float) -> float:
        """Returns a measurement after exactly that many updates; NaN where there was none."""
        (rows,) = np.nonzero(self.columns["updates"] == updates)
        known = len(rows) and measurement in self.columns
        return float(self.columns[measurement][rows[0]]) if known else math.nan

    def mean_until(
        self, measurement: str, budget: float, cost: Callable[[Run], Column] | None = None
    ) -> float:
        """Returns the mean of a measurement along training; NaN if the budget was not spent.

        Args:
            measurement: linear between two evaluations.
            budget: of what is on the axis.
            cost: of the run at each evaluation, the axis; None for updates.
        """
        x = self.columns["updates"] if cost is None else cost(self)
        y = self.columns[measurement]
        if x[-1] < budget:
            return math.nan
        end = float(np.interp(budget, x, y))
        inside = x < budget
        x, y = np.append(x[inside], budget), np.append(y[inside], end)
        return float(np.trapezoid(y, x) / (x[-1] - x[0])) if len(x) > 1 else end

    @property
    def whose_cycles(self) -> tuple[Path, Any]:
        """A key of its cycles: its folder and, where they have one, their seed."""
        return self.folder, self.cycles[0].get("seed") if self.cycles else None

    def shares(self, cycle: Record) -> Column | None:
        """Returns a cycle's shares of proposals, a dimension for each axis; None if unrecorded."""
        sides = tuple(len(values) for values in self.task.space.values())
        try:
            counts = np.asarray(cycle.get("histogram"), float)
        except (ValueError, TypeError):
            return None
        if not sides or counts.shape != sides or not (counts >= 0).all():
            return None
        return counts / counts.sum() if 0 < counts.sum() < math.inf else None


def share_map(shares: Column) -> Column:
    """Returns shares over the first axis (rows) and the second (columns); one row for one axis."""
    return np.atleast_2d(shares.sum(tuple(range(2, shares.ndim))))


def tables(runs: Iterable[tuple[str, Run]], key: str = "run") -> dict[str, pd.DataFrame]:
    """Returns the records of runs as tables, with a row for each evaluation, cycle or level.

    Args:
        runs: each with the name that its rows carry.
        key: the column of that name; where it is not the run's, cycles have its seed beside it.

    Returns:
        By their names; those without rows are left out.
    """
    found: dict[str, list[pd.DataFrame]] = {name: [] for name in NAMES}
    seen: set[Any] = set()
    for name, run in runs:
        place = {key: name, "seed": run.seed}
        for table, own in (("metrics", run.metrics), ("training", run.training)):
            found[table].append(pd.DataFrame(place, own.index).join(own))
        if run.whose_cycles not in seen:
            whose = {key: name} if key == "run" else place
            cells = (
                {k: json.dumps(v) for k, v in cycle.items() if v is not None and v == v}
                for cycle in run.cycles
            )
            # A curriculum may log a number called like the key; the run's name wins.
            found["cycles"].append(pd.DataFrame([whose | cycle | {key: name} for cycle in cells]))
        seen.add(run.whose_cycles)
        for distribution in dict.fromkeys(name.rpartition("_")[0] for name in run.levels):
            # Returns are kept only as the headline, or where there is no success.
            kinds = [
                kind for kind in ("success", "return") if f"{distribution}_{kind}" in run.levels
            ]
            if run.headline != f"{distribution}_return":
                kinds = kinds[:1]
            own = pd.DataFrame({k: pd.Series(run.levels[f"{distribution}_{k}"]) for k in kinds})
            where = {"updates": run.updates, "distribution": distribution, "level": own.index}
            found["levels"].append(pd.DataFrame(place | where).join(own))
    known = {name: [part for part in parts if len(part)] for name, parts in found.items()}
    return {name: pd.concat(parts) for name, parts in known.items() if parts}


def to_csv(table: pd.DataFrame) -> bytes:
    """Returns a table as CSV; whole numbers without a point, NaN as an empty cell."""
    text: str = table.to_csv(
        index=False, lineterminator="\n", float_format=lambda x: repr(float(x)).removesuffix(".0")
    )
    return encoded(text)
