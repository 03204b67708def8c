"""Runs as their folders tell of them. Folders may come from anybody: nothing in one is trusted."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from proposer_rl.report.statistics import Waiting
from proposer_rl.runs.folder import read_csv, read_jsonl

LARGEST_FILE = 64 * 2**20  # bytes; a run at the paper's scale writes less than one MiB
DEEPEST = 4  # folders between the one that was named and a run's
MOST_FOLDERS = 20_000
LONGEST_NAME = 80
WIDEST_GRID = 64

COST = ("updates", "frames", "meta_frames", "seconds")
_LIFETIME = re.compile(r"lifetime_(\d{1,9})")
Column = NDArray[np.float64]


class UnreadableRun(ValueError):
    """A folder looks like a run's but cannot be read; the message is one line."""


@dataclass(frozen=True)
class Run:
    """One seed of one run's folder.

    Attributes:
        folder: where it lies.
        seed: whose rows these are.
        shared_by: seeds that were trained side by side in the folder's process.
        config: the settings, as in ``config.json``.
        facts: versions, device, command and length, from ``run.json`` and ``summary.json``.
        finished: whether it got to the end of its schedule.
        metrics, training: columns of the tables, equally long within a table.
        cycles: the Proposer's records, one per cycle; empty without a Proposer.
        samples: recorded levels, one record per evaluation.
    """

    folder: Path
    seed: int
    shared_by: int
    config: Mapping[str, Any]
    facts: Mapping[str, Any]
    finished: bool
    metrics: Mapping[str, Column]
    training: Mapping[str, Column]
    cycles: Sequence[Mapping[str, Any]]
    samples: Sequence[Mapping[str, Any]]

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
        return str(self.config["schedule"]["headline"])

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
        """Environment frames at each evaluation, those of the copies included."""
        return self.metrics["frames"] + self.metrics["meta_frames"]

    @property
    def own_seconds(self) -> Column:
        """Wall seconds at each evaluation: an even share where seeds were trained together."""
        return self.metrics["seconds"] / self.shared_by

    def waiting(self, measurement: str, threshold: float) -> Waiting:
        """Updates until a measurement first reached a threshold, or censored."""
        reached = np.flatnonzero(self.metrics[measurement] >= threshold)
        if len(reached):
            return Waiting(float(self.metrics["updates"][reached[0]]), True)
        return Waiting(float(self.updates), False)

    def at(self, measurement: str, updates: float) -> float:
        """A measurement after exactly that many updates; NaN where there was none."""
        found = np.flatnonzero(self.metrics["updates"] == updates)
        return float(self.metrics[measurement][found[0]]) if len(found) else math.nan

    def mean_until(self, measurement: str, updates: float) -> float:
        """Mean of a measurement over the first updates; NaN for a shorter run."""
        if self.updates < updates:
            return math.nan
        inside = self.metrics["updates"] <= updates
        x, y = self.metrics["updates"][inside], self.metrics[measurement][inside]
        return float(np.trapezoid(y, x) / (x[-1] - x[0])) if len(x) > 1 else float(y[0])


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Folders of runs: those given, or else those found within them.

    Links to folders are not followed.

    Raises:
        UnreadableRun: if a folder is none, or there is no run in it.
    """
    found: list[Path] = []
    for folder in folders:
        if not folder.is_dir():
            raise UnreadableRun(f"{folder}: there is no such folder")
        inside = [path for path in _walk(folder) if is_run(path)]
        if not inside:
            raise UnreadableRun(
                f"{folder}: no run in it: a run's folder has config.json and metrics.csv, as "
                "bin/train writes them"
            )
        found += inside
    return sorted({path.resolve(): path for path in found}.values())


def is_run(folder: Path) -> bool:
    """Whether a folder looks like a run's."""
    return (folder / "config.json").is_file() and (folder / "metrics.csv").is_file()


def _walk(folder: Path) -> Iterator[Path]:
    for seen, (root, names, _) in enumerate(os.walk(folder)):
        if seen > MOST_FOLDERS:
            raise UnreadableRun(f"{folder}: more than {MOST_FOLDERS} folders in it; name them")
        path = Path(root)
        names.sort()
        if is_run(path) or len(path.relative_to(folder).parts) >= DEEPEST:
            names.clear()
        yield path


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
        raise UnreadableRun(f"{folder}: {' '.join(reason.split())[:300]}") from error


def _read_run(folder: Path) -> list[Run]:
    config = _read_config(folder)
    summary = _read_json(folder, "summary.json") or {}
    facts = {**(_read_json(folder, "run.json") or {}), **summary}
    rows = read_csv(_checked(folder, "metrics.csv"))
    seeds = sorted({int(row["seed"]) for row in rows})
    if not seeds:
        raise ValueError("metrics.csv has no rows yet")
    measured = [f"{name}_success" for name in config["evaluation"]["distributions"]]
    needed = (*COST, *measured, config["schedule"]["headline"])
    training = _optional(folder, "training.csv", read_csv)
    samples = [_checked_sample(row) for row in _optional(folder, "curriculum.jsonl", read_jsonl)]
    runs = []
    for seed in seeds:
        metrics = _columns(rows, seed)
        _check_metrics(metrics, needed)
        runs.append(
            Run(
                folder=folder,
                seed=seed,
                shared_by=len(seeds),
                config=config,
                facts=facts,
                finished=summary.get("updates") == int(metrics["updates"][-1]),
                metrics=metrics,
                training=_columns(training, seed),
                cycles=_checked_cycles(_optional(folder, "proposer.jsonl", read_jsonl)),
                samples=[row for row in samples if row["seed"] == seed],
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
    for name in ("method", "scale", "ablation"):
        value = config.get(name, "none")
        if not isinstance(value, str) or len(value) > LONGEST_NAME or not value.isprintable():
            raise ValueError(f"config.json: {name} is no name")
    measured = config["evaluation"]["distributions"]
    if not isinstance(measured, list) or not all(isinstance(name, str) for name in measured):
        raise ValueError("config.json: evaluation.distributions is no list of names")
    height, width = config["maze"]["height"], config["maze"]["width"]
    if not all(isinstance(n, int) and 0 < n <= WIDEST_GRID for n in (height, width)):
        raise ValueError(f"config.json: a maze of {height} x {width} cells cannot be drawn")
    threshold = config["schedule"]["threshold"]
    if isinstance(threshold, bool) or not isinstance(threshold, int | float):
        raise ValueError("config.json: schedule.threshold is no number")
    return config


def _columns(rows: Sequence[Mapping[str, float]], seed: int) -> dict[str, Column]:
    own = [row for row in rows if row["seed"] == seed]
    names = [name for name in (own[0] if own else {}) if name != "seed"]
    return {name: np.array([row[name] for row in own], dtype=float) for name in names}


def _check_metrics(metrics: Mapping[str, Column], needed: Sequence[str]) -> None:
    for name in needed:
        if name not in metrics:
            raise ValueError(f"metrics.csv has no column {name!r}")
        if not np.isfinite(metrics[name]).all():
            raise ValueError(f"metrics.csv: {name} is not always a number")
    if (np.diff(metrics["updates"]) <= 0).any():
        raise ValueError("metrics.csv: updates do not grow from row to row")


def _checked_cycles(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Records with what the report reads of them in the right form."""
    for row in rows:
        gains, counts = np.asarray(row["total_gain"], float), row.get("histogram")
        if gains.ndim != 1 or not len(gains) or not np.isfinite(gains).all():
            raise ValueError("proposer.jsonl: total_gain is no list of numbers")
        if counts is not None and np.asarray(counts, float).ndim != 2:
            raise ValueError("proposer.jsonl: histogram is no table of counts")
        float(row["updates"])
    return [dict(row) for row in rows]


def _checked_sample(row: Mapping[str, Any]) -> dict[str, Any]:
    """A record of levels, each at most as large as can be drawn, with the path inside of it."""
    for item in row["levels"]:
        lines, path = item["level"], np.asarray(item["path"])
        if not (0 < len(lines) <= WIDEST_GRID and all(isinstance(line, str) for line in lines)):
            raise ValueError("curriculum.jsonl: a level is no drawing")
        width = len(lines[0])
        inside = path.ndim == 2 and path.shape[1] == 2 and (path >= 0).all()
        if not inside or width > WIDEST_GRID or (path >= (len(lines), width)).any():
            raise ValueError("curriculum.jsonl: a path leaves its level")
    return {**row, "updates": int(row["updates"]), "seed": int(row["seed"])}
