"""Runs in a few tidy tables: of a report, and of a study, which is read as runs are.

A study's folder has ``runs.csv.xz``, a row for each run with its settings and facts as JSON, and
the tables ``metrics``, ``training``, ``cycles`` and ``levels``, each a row for what a run recorded
at one moment, of one cycle or of one level. Cells of ``cycles`` are JSON, so that lists stay lists.
Every number is written so that it reads back bit for bit.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from pathlib import Path

import pandas as pd

from proposer_rl.report.runs import Run
from proposer_rl.runs.folder import read_bounded
from proposer_rl.runs.records import encoded

STUDY = "runs.csv.xz"  # what makes a folder a study's
NAMES = ("metrics", "training", "cycles", "levels")
LARGEST_FILE = 64 * 2**20  # bytes, unpacked


def tables(runs: Iterable[tuple[str, Run]], key: str = "run") -> dict[str, pd.DataFrame]:
    """What runs recorded, as tables.

    Args:
        runs: each with the name that its rows carry.
        key: the column of that name; where it is not the run's, cycles have its seed beside it.

    Returns:
        By their names; those without rows are left out.
    """
    found: dict[str, list[pd.DataFrame]] = {name: [] for name in NAMES}
    seen: set[Path] = set()
    for name, run in runs:
        place = {key: name, "seed": run.seed}
        for table, own in (("metrics", run.metrics), ("training", run.training)):
            found[table].append(pd.DataFrame(place, own.index).join(own))
        if run.folder not in seen:  # seeds that were trained together have one curriculum
            whose = {key: name} if key == "run" else place
            cells = (
                {k: json.dumps(v) for k, v in cycle.items() if v is not None and v == v}
                for cycle in run.cycles
            )
            # A curriculum may log a number of that name: a row stays its run's.
            found["cycles"].append(pd.DataFrame([whose | cycle | {key: name} for cycle in cells]))
        seen.add(run.folder)
        for distribution in dict.fromkeys(name.rpartition("_")[0] for name in run.levels):
            # Of returns what is shown: the headline, and where there is no success.
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
    """A table as CSV; whole numbers without a point, an empty cell where there is none."""
    text: str = table.to_csv(
        index=False, lineterminator="\n", float_format=lambda x: repr(float(x)).removesuffix(".0")
    )
    return encoded(text)


def read_table(file: Path) -> pd.DataFrame:
    """A table of a study, its cells as text; NaN where one is empty."""
    import lzma  # which not every Python is built with

    if file.is_symlink():
        raise ValueError(f"{file.name} is not a plain file")
    content = read_bounded(file, LARGEST_FILE)
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=2 * LARGEST_FILE)
    try:
        text = unpacker.decompress(content, LARGEST_FILE + 1)
    except (lzma.LZMAError, EOFError) as error:
        raise ValueError(f"{file.name} is not packed by xz: {error}") from None
    if len(text) > LARGEST_FILE or not unpacker.eof:
        raise ValueError(f"{file.name} is cut off, or larger than {LARGEST_FILE // 2**20} MiB")
    return pd.read_csv(
        io.BytesIO(text), dtype=str, keep_default_na=False, na_values=[""], index_col=False
    )
