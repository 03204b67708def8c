"""Runs without what no table or curve needs: small enough to publish, and read as any run is."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from proposer_rl.report.build import OutputError
from proposer_rl.report.reading import begun, find_runs, read_run
from proposer_rl.report.records import anywhere
from proposer_rl.runs.folder import PROPOSER, read_jsonl, storage, write_atomically

BULK = ("checkpoints", "curriculum.jsonl")  # what no copy has
UNCHANGED = ("metrics.csv", "training.csv")


def publish(folders: Sequence[Path], output: Path) -> tuple[list[Path], list[str]]:
    """Copy finished runs, without checkpoints, pictures of levels and this machine's folders.

    Of a Proposer that has had several lifetimes what it has learnt comes along. Tables, and
    figures without levels in them, come out of the copies as they do of the runs.

    Args:
        folders: of runs, or with runs in them.
        output: folder to write to, laid out as they are below the folders named; of the runs in it
            those in the same places are replaced.

    Returns:
        The folders that were written, and a line for each run that was left out.

    Raises:
        UnreadableRun: if a folder has no run, or one cannot be read.
        OutputError: if the output folder holds something else, or two runs have one place.
    """
    found = _places(folders)
    _check(output)
    light, notes = {}, []
    for place, folder in found.items():
        if all(run.finished for run in read_run(folder)):
            light[place] = _light(folder)
        else:
            notes.append(f"left out: {place}: not finished")
    for place in light:
        for name in BULK:
            if (output / place / name).exists():
                raise OutputError(f"--publish: {output / place} has {name}, so it is no copy")
    for place, files in light.items():
        _replace(output / place, files)
    return [output / place for place in light], notes


def _places(folders: Sequence[Path]) -> dict[Path, Path]:
    """The runs by where they are to lie: as they do below the folder that was named."""
    found: dict[Path, Path] = {}
    for folder in map(Path.resolve, folders):
        for run in find_runs([folder]):
            place = Path(folder.name) if run == folder else run.relative_to(folder)
            other = found.setdefault(place, run)
            if other != run:
                raise OutputError(f"--publish: two runs are called {place}: {other}, {run}")
    return found


def _check(output: Path) -> None:
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output}: is a file; give a folder for the runs")
    for path in sorted(output.glob("[!.]*")):
        if not path.is_dir() or not any(begun(path)):
            raise OutputError(f"{output}: has {path.name} in it, which is no run; give another")


def _light(folder: Path) -> dict[str, bytes]:
    """Contents of the files, by name."""
    run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    run["task"].pop("samples", None)
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    reused = str(config.get("checkpoint") or "")
    # A Proposer that has learnt on several Solvers is meant for others.
    names = (*UNCHANGED, PROPOSER) if config.get("lifetimes", 1) != 1 else UNCHANGED
    files = {name: (folder / name).read_bytes() for name in names if (folder / name).exists()}
    summary = (folder / "summary.json").read_text(encoding="utf-8")  # repeats the run's command
    texts = {"run.json": _json(run), "config.json": _json(config), "summary.json": summary}
    files |= {name: _anywhere(text, reused).encode() for name, text in texts.items()}
    for name in ("cycles.jsonl", "levels.jsonl"):
        if (folder / name).exists():
            rows = map(_without_bulk, read_jsonl(folder / name))
            files[name] = "".join(f"{json.dumps(row)}\n" for row in rows).encode()
    return files


def _without_bulk(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row without pictures of levels; without returns where success is what is shown."""
    dropped = {"levels", "return"} if "success" in row else {"levels"}
    return {key: value for key, value in row.items() if key not in dropped}


def _json(value: Any) -> str:
    return json.dumps(value, indent=1) + "\n"


def _anywhere(text: str, reused: str) -> str:
    """JSON without this machine's folders; of a checkpoint begun with the path's last two parts.

    Seeds of Proposers are called by the folders above their last lifetimes.
    """
    if os.path.isabs(reused):
        text = text.replace(json.dumps(reused)[1:-1], "/".join(Path(reused).parts[1:][-2:]))
    return anywhere(text)


def _replace(folder: Path, files: Mapping[str, bytes]) -> None:
    """All of it or nothing: a crash leaves a folder whose name begins with a dot."""
    temporary = folder.with_name(f".{folder.name}.tmp")
    with storage(folder):
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir(parents=True)
        for name, content in files.items():
            write_atomically(temporary / name, content)
        if folder.exists():
            shutil.rmtree(folder)
        os.rename(temporary, folder)
