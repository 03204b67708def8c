"""Reads runs from their folders, or from the tables of a study."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from proposer_rl.report.runs import COST, NAMES, STUDY, Run
from proposer_rl.runs.folder import FAILURE, is_rate, read_csv, read_jsonl
from proposer_rl.runs.records import (
    LARGEST,
    Column,
    Record,
    SampleRecord,
    TaskFacts,
    checked,
    natural,
    printable,
)

ROUNDING = 1e-5  # by which a share may lie outside of 0 to 1


class UnreadableRun(ValueError):
    """A folder looks like a run's but cannot be read; the message is one line."""

    exit_code = 2


class OutputError(ValueError):
    """A report cannot be written as asked; the message is one line."""

    exit_code = 2


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Finds the folders of runs and studies in some folders, each once, in natural order."""
    found: list[Path] = []
    for folder in folders:
        inside = [
            path
            for path, files in _walk(folder)
            if STUDY in files or {"config.json", "metrics.csv"} <= files
        ]
        if not inside:
            raise UnreadableRun(
                f"{folder}: holds no runs; a run's folder has config.json and metrics.csv, and a "
                f"study's {STUDY}"
            )
        found += inside
    each_once = {path.resolve(): path for path in found}.values()
    return sorted(each_once, key=lambda path: [natural(part) for part in path.parts])


def begun(folder: Path) -> list[Path]:
    """Finds the folders of runs in a folder, or itself, including those without measurements."""
    return [path for path, files in _walk(folder) if STUDY not in files]


def _walk(folder: Path) -> Iterator[tuple[Path, set[str]]]:
    """Yields folders of runs and studies with their files' names; skips links and hidden ones."""
    if not folder.is_dir():
        raise UnreadableRun(f"{folder}: there is no such folder")
    for root, names, files in os.walk(folder):
        # A study that is being published has hidden folders.
        names[:] = sorted((n for n in names if not n.startswith(".")), key=natural)
        if {"config.json", STUDY} & set(files):
            names.clear()
        if {"config.json", FAILURE, STUDY} & set(files):
            yield Path(root), set(files)


def read_run(folder: Path) -> list[Run]:
    """Returns all seeds of a run's folder, or all runs of a study.

    Raises:
        UnreadableRun: for an invalid folder, with the reason; a report leaves it out and says so.
    """
    try:
        return _read_study(folder) if (folder / STUDY).exists() else _read_folder(folder)
    except Exception as error:  # xz and pandas raise many kinds
        missing = isinstance(error, KeyError)
        reason = f"an entry {error} is missing" if missing else str(error) or repr(error)
        raise UnreadableRun(f"{folder}: {printable(reason)[:300]}") from error


def _read_folder(folder: Path) -> list[Run]:
    recorded = _optional(folder / "curriculum.jsonl", read_jsonl)
    return _runs(
        folder,
        _read_json(folder / "config.json"),
        _read_json(folder / "run.json")
        | ({} if not (folder / "summary.json").exists() else _read_json(folder / "summary.json")),
        pd.DataFrame(read_csv(folder / "metrics.csv")),
        pd.DataFrame(_optional(folder / "training.csv", read_csv)),
        _optional(folder / "cycles.jsonl", read_jsonl),
        _optional(folder / "levels.jsonl", read_jsonl),
        checked(list[SampleRecord], recorded, "curriculum.jsonl"),
    )


def _read_study(folder: Path) -> list[Run]:
    """Returns the runs of a study, as ``bin/report --publish`` writes it."""
    tables = {name: _by_run(folder, name) for name in NAMES}
    runs = []
    for row in _table(folder / STUDY).to_dict("records"):
        name = row["run"]
        metrics, training, cycles, levels = (
            tables[table].get(name, pd.DataFrame()) for table in NAMES
        )
        recorded = [
            {key: json.loads(cell) for key, cell in cycle.items() if cell == cell}
            for cycle in cycles.to_dict("records")
        ]
        runs += _runs(
            folder / name,
            json.loads(row["config"]),
            json.loads(row["facts"]),
            metrics.astype(float),
            training.astype(float),
            recorded,
            _level_results(levels),
            (),
        )
    return runs


def _table(file: Path) -> pd.DataFrame:
    """Returns a table of a study with its cells as text, NaN for empty ones."""
    return pd.read_csv(file, dtype=str, keep_default_na=False, na_values=[""], index_col=False)


def _by_run(folder: Path, name: str) -> dict[str, pd.DataFrame]:
    """Returns a table of a study split by runs, each without columns that are empty in it."""
    if not (folder / f"{name}.csv.xz").exists():
        return {}
    table = _table(folder / f"{name}.csv.xz")
    values = table.drop(columns="run")
    known = values.notna().groupby(table["run"]).any()
    places = values.groupby(table["run"]).indices
    return {
        str(run): values.loc[:, known.loc[run].to_numpy()].iloc[rows]
        for run, rows in places.items()
    }


def _level_results(levels: pd.DataFrame) -> list[Record]:
    """Returns a study's results on single levels, with a record for each seed as in a folder."""
    if not len(levels):
        return []
    place = ["seed", "updates", "distribution"]
    found = []
    for (seed, updates, name), own in levels.groupby(place, sort=False):
        about = {"seed": int(seed), "updates": int(updates), "distribution": name}
        known = own.drop(columns=[*place, "level"]).astype(float).dropna(axis=1)
        found.append(about | known.to_dict("list"))
    return found


def _runs(
    folder: Path,
    config: dict[str, Any],
    facts: dict[str, Any],
    metrics: pd.DataFrame,
    training: pd.DataFrame,
    cycles: Sequence[Any],
    levels: Sequence[Record],
    samples: Sequence[SampleRecord],
) -> list[Run]:
    """Returns a run for each seed; ``facts`` have ``updates`` only of finished runs."""
    task = checked(TaskFacts, facts["task"], "run.json: task")
    seeds = sorted(metrics["seed"].astype(int).unique().tolist())
    runs = []
    for seed in seeds:
        run = Run(
            folder=folder,
            seed=seed,
            shared_by=len(seeds),
            config=config,
            facts=facts,
            task=task,
            finished=False,
            metrics=_of_seed(metrics, seed),
            training=_of_seed(training, seed),
            cycles=[row for row in cycles if row.get("seed", seed) == seed],
            samples=[sample for sample in samples if sample.seed == seed],
        )
        _check_metrics(run)
        finished = facts.get("updates") == run.updates
        runs.append(replace(run, finished=finished, levels=_levels(levels, seed, run.updates)))
    return runs


def _optional(file: Path, read: Callable[[Path], list[Any]]) -> list[Any]:
    return read(file) if file.exists() else []


def _read_json(file: Path) -> dict[str, Any]:
    value = json.loads(file.read_text("utf-8-sig"))  # editors on Windows add a byte-order mark
    return checked(dict[str, Any], value, file.name)


def _levels(rows: Sequence[Record], seed: int, updates: int) -> dict[str, Column]:
    """Returns a seed's results on every level after that many updates, [levels] by column."""
    found = {}
    for row in rows:
        if (row["seed"], row["updates"]) == (seed, updates):
            for kind in ("success", "return"):
                if row.get(kind) is not None:
                    name = f"{row['distribution']}_{kind}"
                    found[name] = _rounded(is_rate(name), np.array(row[kind], float))
    return found


def _rounded(rate: bool | NDArray[np.bool_], values: Column) -> Column:
    """Returns values [n], with rates that rounding put outside of 0 to 1 moved inside."""
    inside = values.clip(0, 1)
    return np.where(rate & (np.abs(values - inside) < ROUNDING), inside, values)


def _of_seed(table: pd.DataFrame, seed: int) -> pd.DataFrame:
    if not len(table):
        return table
    names = [*table.columns.drop("seed")]
    values = table[names].to_numpy(float)[table["seed"].to_numpy() == seed]
    known = np.where(np.abs(values) < LARGEST, values, np.nan)
    return pd.DataFrame(_rounded(np.array([*map(is_rate, names)], bool), known), columns=names)


def _check_metrics(run: Run) -> None:
    """Refuses tables that would silently make every comparison wrong."""
    needed = {*COST, *run.measurements, run.headline}
    unknown = run.metrics.reindex(columns=sorted(needed)).isna().any()
    if unknown.any():
        raise ValueError(f"metrics.csv: {unknown.idxmax()} is not always a number")
    if (np.diff(run.metrics["updates"]) <= 0).any():
        raise ValueError("metrics.csv: updates must increase from row to row")
