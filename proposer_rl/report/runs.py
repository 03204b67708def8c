"""Runs as their folders tell of them. Folders may come from anybody: nothing in one is trusted."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from proposer_rl.report.records import (
    LARGEST,
    Column,
    LevelRecord,
    LevelResults,
    Name,
    Record,
    SampleRecord,
    Sheets,
    TaskFacts,
    checked,
    number,
    printable,
)
from proposer_rl.runs.columns import is_rate
from proposer_rl.runs.folder import read_csv, read_jsonl

LARGEST_FILE = 64 * 2**20  # bytes; a run at the paper's scale writes a few MiB
MOST_FOLDERS = 20_000
FAILURE = "error.json"  # what a sweep leaves in the folder of a run that failed
ROUNDING = 1e-5  # by which a share may lie outside of 0 to 1

COST = ("updates", "frames", "curriculum_frames", "evaluations", "seconds")
# Columns of training.csv that are PPO's own, besides its losses; the others are the task's.
OF_PPO = {"entropy", "kl_approx", "clip_fraction", "explained_variance", "grad_norm"}
_LIFETIME = re.compile(r"lifetime_(\d{1,9})")


class UnreadableRun(ValueError):
    """A folder looks like a run's but cannot be read; the message is one line."""

    exit_code = 2


class Waiting(NamedTuple):
    """Updates until a threshold, of one run.

    Attributes:
        updates: when it was reached or, for a censored run, how long the run was.
        reached: whether it was; False for a censored run.
    """

    updates: float
    reached: bool


@dataclass(frozen=True)
class Run:
    """One seed of one run's folder.

    Attributes:
        folder: where it lies.
        seed: whose rows these are.
        shared_by: seeds that were trained side by side in the folder's process.
        config: the settings, as in ``config.json``.
        facts: versions, device, command and length, from ``run.json`` and ``summary.json``.
        task: what ``run.json`` says of the task.
        finished: whether it got to the end of its schedule.
        metrics, training: columns of the tables, equally long within a table.
        cycles: what the curriculum recorded, one per cycle; every entry but updates is optional.
        samples: recorded levels, one record per evaluation.
        levels: what was reached on every level at the end, [levels], by the measurement's column.
        sheets: pictures of levels by their captions, as the curriculum told of them last.
    """

    folder: Path
    seed: int
    shared_by: int
    config: Mapping[str, Any]
    facts: Mapping[str, Any]
    task: TaskFacts
    finished: bool
    metrics: Mapping[str, Column]
    training: Mapping[str, Column]
    cycles: Sequence[Record]
    samples: Sequence[SampleRecord]
    levels: Mapping[str, Column] = field(default_factory=dict)
    sheets: Mapping[str, Sequence[LevelRecord]] = field(default_factory=dict)

    @property
    def method(self) -> str:
        """Name of the method."""
        return str(self.config["method"])

    @property
    def ablation(self) -> str:
        """Name of the ablation, ``none`` without one."""
        return str(self.config.get("ablation", "none"))

    @property
    def lifetime(self) -> int | None:
        """Which Solver of several lifetimes this was, from 0; None for a run of one."""
        found = (
            _LIFETIME.fullmatch(self.folder.name) if self.config.get("lifetimes", 1) != 1 else None
        )
        return int(found[1]) if found else None

    @property
    def headline(self) -> str:
        """The measurement that runs are summed up by."""
        return _headline(self.config)

    @property
    def measurements(self) -> list[str]:
        """A column for each distribution measured on: success or, where that is none, return."""
        return _measurements(self.task, self.metrics)

    @property
    def statistics(self) -> list[str]:
        """Columns of the training's table that are the task's statistics."""
        own = {"updates", *OF_PPO}
        return [n for n in self.training if n not in own and not n.startswith("loss_")]

    @property
    def updates(self) -> int:
        """Updates of the Solver at the last evaluation."""
        return int(self.metrics["updates"][-1])

    @property
    def planned(self) -> int | None:
        """Updates that the run shall have; None where the folder does not say."""
        value = self.facts.get("planned_updates", self.facts.get("updates"))
        return value if isinstance(value, int) else None

    @property
    def total_frames(self) -> Column:
        """Environment frames at each evaluation, those that the curriculum spent included."""
        return self.metrics["frames"] + self.metrics["curriculum_frames"]

    @property
    def own_seconds(self) -> Column:
        """Wall seconds at each evaluation: an even share where seeds were trained together."""
        return self.metrics["seconds"] / self.shared_by

    def until(self, horizon: int) -> Run:
        """The run as it was after so many updates, measurements linear between evaluations.

        What is only known of its end is left out. A shorter run stays as it is.
        """
        if self.updates <= horizon:
            return self
        x = self.metrics["updates"]
        metrics = {
            name: np.append(column[x < horizon], np.interp(horizon, x, column))
            for name, column in self.metrics.items()
        }
        early = self.training.get("updates", np.empty(0)) <= horizon
        return replace(
            self,
            metrics=metrics,
            training={name: column[early] for name, column in self.training.items()},
            cycles=[cycle for cycle in self.cycles if number(cycle["updates"]) < horizon],
            samples=[sample for sample in self.samples if sample.updates <= horizon],
            levels={},
            sheets={},
        )

    def waiting(self, measurement: str, threshold: float) -> Waiting:
        """Updates until a measurement first reached a threshold, or censored."""
        reached = np.flatnonzero(self.metrics[measurement] >= threshold)
        if len(reached):
            return Waiting(float(self.metrics["updates"][reached[0]]), True)
        return Waiting(float(self.updates), False)

    def waited(self, measurement: str, threshold: float, horizon: float) -> float:
        """Updates until a threshold, cut at a horizon; NaN for a run that is not that long.

        Also where it was reached: short runs that did would else count, and those that did not
        would not.
        """
        waiting = self.waiting(measurement, threshold)
        if self.updates < horizon:
            return math.nan
        return min(waiting.updates, horizon) if waiting.reached else horizon

    def at(self, measurement: str, updates: float) -> float:
        """A measurement after exactly that many updates; NaN where there was none."""
        found = np.flatnonzero(self.metrics["updates"] == updates)
        return float(self.metrics[measurement][found[0]]) if len(found) else math.nan

    def mean_until(
        self, measurement: str, budget: float, cost: Callable[[Run], Column] | None = None
    ) -> float:
        """Mean of a measurement along training; NaN for a run that did not spend the budget.

        Args:
            measurement: linear between two evaluations.
            budget: of what is on the axis.
            cost: of the run at each evaluation, the axis; None for updates.
        """
        x, y = self.metrics["updates"] if cost is None else cost(self), self.metrics[measurement]
        if x[-1] < budget:
            return math.nan
        end = float(np.interp(budget, x, y))
        inside = x < budget
        x, y = np.append(x[inside], budget), np.append(y[inside], end)
        return float(np.trapezoid(y, x) / (x[-1] - x[0])) if len(x) > 1 else end

    def shares(self, cycle: Record) -> Column | None:
        """Shares of a cycle's proposals, a dimension for each axis; None if not recorded."""
        sides = tuple(len(values) for values in self.task.space.values())
        try:
            counts = np.asarray(cycle.get("histogram"), float)
        except (ValueError, TypeError, OverflowError):
            return None
        if not sides or counts.shape != sides or not (counts >= 0).all():
            return None
        return counts / counts.sum() if 0 < counts.sum() < math.inf else None


def share_map(shares: Column) -> Column:
    """Shares over the first axis (rows) and the second (columns); of one axis a single row."""
    return np.atleast_2d(shares.sum(tuple(range(2, shares.ndim))))


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Folders of runs: those given, or else those found within them.

    Raises:
        UnreadableRun: if a folder is none, or there is no run in it.
    """
    found: list[Path] = []
    for folder in folders:
        inside = [path for path, files in begun(folder) if {"config.json", "metrics.csv"} <= files]
        if not inside:
            raise UnreadableRun(
                f"{folder}: no run in it: a run's folder has config.json and metrics.csv, as "
                "bin/train writes them"
            )
        found += inside
    return sorted({path.resolve(): path for path in found}.values())


def begun(folder: Path) -> Iterator[tuple[Path, set[str]]]:
    """Folders of runs in a folder, or itself, with names of their files; links are not followed.

    Raises:
        UnreadableRun: if there is no such folder, or there are too many in it.
    """
    if not folder.is_dir():
        raise UnreadableRun(f"{folder}: there is no such folder")
    for seen, (root, names, files) in enumerate(os.walk(folder)):
        if seen > MOST_FOLDERS:
            raise UnreadableRun(f"{folder}: more than {MOST_FOLDERS} folders in it; name them")
        path = Path(root)
        names.sort()
        if "config.json" in files:
            names.clear()
        if {"config.json", FAILURE} & set(files):
            yield path, set(files)


def read_run(folder: Path) -> list[Run]:
    """All seeds of a run's folder.

    Raises:
        UnreadableRun: naming the file that is missing, too large, or not what it should be.
    """
    try:
        return _read_run(folder)
    except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        missing = isinstance(error, KeyError)
        reason = f"an entry {error} is missing" if missing else str(error) or repr(error)
        raise UnreadableRun(f"{folder}: {printable(reason)[:300]}") from error


def _read_run(folder: Path) -> list[Run]:
    config = _read_config(folder)
    summary = _read_json(folder, "summary.json") or {}
    facts = {**(_read_json(folder, "run.json") or {}), **summary}
    task = checked(TaskFacts, facts["task"], "run.json: task")
    rows = read_csv(_checked(folder, "metrics.csv"))
    seeds = sorted({int(row["seed"]) for row in rows})
    if not seeds:
        raise ValueError("metrics.csv has no rows yet")
    training = _optional(folder, "training.csv", read_csv)
    if training and "updates" not in training[0]:
        raise ValueError("training.csv has no column 'updates'")
    cycles = _optional(folder, "cycles.jsonl", read_jsonl)
    if any(math.isnan(number(row["updates"])) for row in cycles):
        raise ValueError("cycles.jsonl: updates is no number")
    sheets = [checked(Sheets, row.pop("levels", {}), "cycles.jsonl: levels") for row in cycles]
    recorded = _optional(folder, "curriculum.jsonl", read_jsonl)
    samples = checked(list[SampleRecord], recorded, "curriculum.jsonl")
    reached = _optional(folder, "levels.jsonl", read_jsonl)
    levels = checked(list[LevelResults], reached, "levels.jsonl")
    runs = []
    for seed in seeds:
        metrics = _columns(rows, seed)
        _check_metrics(metrics, {*COST, *_measurements(task, metrics), _headline(config)})
        runs.append(
            Run(
                folder=folder,
                seed=seed,
                shared_by=len(seeds),
                config=config,
                facts=facts,
                task=task,
                finished=summary.get("updates") == int(metrics["updates"][-1]),
                metrics=metrics,
                training=_columns(training, seed),
                cycles=cycles,
                samples=[sample for sample in samples if sample.seed == seed],
                levels=_levels(levels, seed, int(metrics["updates"][-1])),
                sheets=_last_sheets(cycles, sheets, seed),
            )
        )
    return runs


def _checked(folder: Path, name: str) -> Path:
    path = folder / name
    if path.is_symlink() or not path.is_file():
        raise ValueError(f"{name} is not a plain file")
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"{name} is larger than {LARGEST_FILE // 2**20} MiB")
    return path


def _optional(folder: Path, name: str, read: Any) -> list[Any]:
    return read(_checked(folder, name)) if (folder / name).exists() else []


def _read_json(folder: Path, name: str) -> dict[str, Any] | None:
    if not (folder / name).exists():
        return None
    value = json.loads(_checked(folder, name).read_text(encoding="utf-8"))
    if not isinstance(value, dict):
        raise ValueError(f"{name} is not a JSON object")
    return value


def _read_config(folder: Path) -> dict[str, Any]:
    config = _read_json(folder, "config.json")
    if config is None:
        raise ValueError("there is no config.json")
    checked(Name, config["method"], "config.json: method")
    for name in ("scale", "ablation"):
        checked(Name, config.get(name, "none"), f"config.json: {name}")
    checked(Name, config["schedule"]["headline"], "config.json: schedule.headline")
    if math.isnan(number(config["schedule"]["threshold"])):
        raise ValueError("config.json: schedule.threshold is no number")
    return config


def _headline(config: Mapping[str, Any]) -> str:
    headline: str = config["schedule"]["headline"]
    return headline


def _measurements(task: TaskFacts, metrics: Mapping[str, Column]) -> list[str]:
    columns = [[f"{name}_success", f"{name}_return"] for name in task.distributions]
    found = [next((name for name in pair if name in metrics), None) for pair in columns]
    return [name for name in found if name is not None]


def _levels(rows: Sequence[LevelResults], seed: int, updates: int) -> dict[str, Column]:
    """What a seed reached on every level after that many updates."""
    found = {}
    for row in rows:
        if (row.seed, row.updates) == (seed, updates):
            for kind, values in (("success", row.success), ("return", row.returns)):
                if values is not None:
                    name = f"{row.distribution}_{kind}"
                    found[name] = _rounded(name, np.array(values, float))
    return found


def _last_sheets(cycles: Sequence[Record], sheets: Sequence[Any], seed: int) -> Any:
    """The pictures of the last cycle that has any, of a seed where it says whose they are."""
    own = [s for row, s in zip(cycles, sheets, strict=True) if s and row.get("seed", seed) == seed]
    return own[-1] if own else {}


def _rounded(name: str, values: Column) -> Column:
    """A share as it is: a sum of probabilities is rounded, to 1.0000001 too."""
    inside = values.clip(0, 1)
    return np.where(is_rate(name) & (np.abs(values - inside) < ROUNDING), inside, values)


def _columns(rows: Sequence[Mapping[str, float]], seed: int) -> dict[str, Column]:
    own = [row for row in rows if row["seed"] == seed]
    columns = {}
    for name in own[0] if own else ():
        values = _rounded(name, np.array([row[name] for row in own], dtype=float))
        checked(Name, name, "the name of a column")
        columns[name] = np.where(np.abs(values) < LARGEST, values, np.nan)
    columns.pop("seed", None)
    return columns


def _check_metrics(metrics: Mapping[str, Column], needed: set[str]) -> None:
    for name in sorted(needed):
        if name not in metrics:
            raise ValueError(f"metrics.csv has no column {name!r}")
        if not np.isfinite(metrics[name]).all():
            raise ValueError(f"metrics.csv: {name} is not always a number")
    if (np.diff(metrics["updates"]) <= 0).any():
        raise ValueError("metrics.csv: updates do not grow from row to row")
