"""A study as data: runs in a few tidy tables, small enough for a repository and read as runs are.

A study's folder has ``runs.csv.gz``, a row for each run with its settings and facts as JSON, and
the tables ``metrics``, ``training``, ``cycles`` and ``levels``, each a row for what a run recorded
at one moment, of one cycle or of one level. Cells of ``cycles`` are JSON, so that lists stay lists.
Every number is written so that it reads back bit for bit.
"""

from __future__ import annotations

import gzip
import io
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from proposer_rl.report.runs import Run
from proposer_rl.runs.folder import read_bounded, write_atomically

STUDY = "runs.csv.gz"  # what makes a folder a study's
NAMES = ("metrics", "training", "cycles", "levels")
LARGEST_FILE = 64 * 2**20  # bytes, unpacked

Rows = list[dict[str, Any]]


def tables(runs: Iterable[tuple[str, Run]], key: str = "run") -> dict[str, Rows]:
    """What runs recorded, as rows.

    Args:
        runs: each with the name that its rows carry.
        key: the column of that name; where it is not the run's, cycles have its seed beside it.

    Returns:
        By the name of the table its rows; tables without rows are left out.
    """
    found: dict[str, Rows] = {name: [] for name in NAMES}
    seen: set[Path] = set()
    for name, run in runs:
        place = {key: name, "seed": run.seed}
        for table in ("metrics", "training"):
            columns: Mapping[str, Any] = getattr(run, table)
            for values in zip(*columns.values(), strict=True):
                found[table].append(place | dict(zip(columns, map(_plain, values), strict=True)))
        if run.folder not in seen:  # seeds that were trained together have one curriculum
            whose = {key: name} if key == "run" else place
            found["cycles"] += [whose | _cycle(cycle) for cycle in run.cycles]
        seen.add(run.folder)
        for distribution in dict.fromkeys(key.rpartition("_")[0] for key in run.levels):
            # Returns where there is no success, which is what is shown.
            kind = "success" if f"{distribution}_success" in run.levels else "return"
            where = place | {"updates": run.updates, "distribution": distribution}
            found["levels"] += [
                where | {"level": level, kind: float(value)}
                for level, value in enumerate(run.levels[f"{distribution}_{kind}"])
            ]
    return {name: rows for name, rows in found.items() if rows}


def to_csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Rows as CSV; an empty cell where a row has nothing, or no number, under a column."""
    import pandas as pd  # only now: what looks at runs without writing any comes at once

    # As objects, so that whole numbers stay whole in columns with empty cells.
    text: str = pd.DataFrame(rows, dtype=object).to_csv(index=False, lineterminator="\n")
    return text.encode()


def write_study(folder: Path, runs: Sequence[tuple[str, Run]]) -> None:
    """Write the tables of a study; those of a former one are replaced.

    Args:
        folder: of the study.
        runs: each with its name, for all seeds of a folder the same.
    """
    listed = [
        {
            "run": name,
            "method": run.method,
            "ablation": run.ablation,
            "updates": run.updates,
            "config": json.dumps(run.config),
            "facts": json.dumps(dict(run.facts)),
        }
        for name, run in dict(runs).items()
    ]
    written = {"runs": listed, **tables(runs)}
    for name in NAMES:
        if name not in written:
            (folder / f"{name}.csv.gz").unlink(missing_ok=True)
    for name, rows in reversed(written.items()):  # what makes it a study comes last
        packed = gzip.compress(to_csv(rows), 9, mtime=0)
        write_atomically(folder / f"{name}.csv.gz", packed)


def read_table(file: Path) -> Iterator[dict[str, str]]:
    """The rows of a table of a study, as text; cells that are empty are left out.

    Raises:
        ValueError: if it is none, or too large.
    """
    if file.is_symlink():
        raise ValueError(f"{file.name} is not a plain file")
    content = read_bounded(file, LARGEST_FILE)
    unpacker = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        text = unpacker.decompress(content, LARGEST_FILE + 1)
    except zlib.error as error:
        raise ValueError(f"{file.name} is not packed by gzip: {error}") from None
    if len(text) > LARGEST_FILE or not unpacker.eof:
        raise ValueError(f"{file.name} is cut off, or larger than {LARGEST_FILE // 2**20} MiB")
    import pandas as pd

    frame = pd.read_csv(io.BytesIO(text), dtype=str, keep_default_na=False, index_col=False)
    for row in frame.fillna("").to_dict("records"):
        yield {str(key): cell for key, cell in row.items() if cell}


def _cycle(cycle: Mapping[str, Any]) -> dict[str, str]:
    return {k: json.dumps(v) for k, v in cycle.items() if v is not None and v == v}


def _plain(value: Any) -> float | int:
    number = float(value)
    return int(number) if number.is_integer() and abs(number) < 2**53 else number
