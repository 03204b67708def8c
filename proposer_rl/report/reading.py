"""Runs are read from their folders, which may come from anybody: nothing in one is trusted."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from proposer_rl.report.records import (
    LARGEST,
    Column,
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
from proposer_rl.report.runs import COST, Run, headline_of, measurements_of
from proposer_rl.runs.columns import is_rate
from proposer_rl.runs.folder import read_csv, read_jsonl

LARGEST_FILE = 64 * 2**20  # bytes; a run at the paper's scale writes a few MiB
MOST_FOLDERS = 20_000
FAILURE = "error.json"  # what a sweep leaves in the folder of a run that failed
ROUNDING = 1e-5  # by which a share may lie outside of 0 to 1


class UnreadableRun(ValueError):
    """A folder looks like a run's but cannot be read; the message is one line."""

    exit_code = 2


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
    """Folders of runs in a folder, or itself, with names of their files.

    Links are not followed, hidden folders not looked into.

    Raises:
        UnreadableRun: if there is no such folder, or there are too many in it.
    """
    if not folder.is_dir():
        raise UnreadableRun(f"{folder}: there is no such folder")
    for seen, (root, names, files) in enumerate(os.walk(folder)):
        if seen > MOST_FOLDERS:
            raise UnreadableRun(f"{folder}: more than {MOST_FOLDERS} folders in it; name them")
        path = Path(root)
        # Hidden are those of a run that is being published.
        names[:] = sorted(name for name in names if not name.startswith("."))
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
        _check_metrics(metrics, {*COST, *measurements_of(task, metrics), headline_of(config)})
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
