"""Writes finished runs as a study, a folder of a few tables, small enough for a repository.

Checkpoints, pictures of levels and this machine's folders are left out, and fractions have six
significant digits. A study is read as runs are.
"""

from __future__ import annotations

import json
import lzma
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from proposer_rl.report import arena
from proposer_rl.report.build import FIGURES, check_output, read_checked
from proposer_rl.report.figures import heat_maps, learning_curves
from proposer_rl.report.page import document, over_tasks, report_command, section
from proposer_rl.report.reading import OutputError, find_runs, read_run
from proposer_rl.report.runs import NAMES, STUDY, Run, tables, to_csv
from proposer_rl.report.style import Drawing, in_few_colours, render
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.records import anywhere, encoded

MARK = "<!-- Write above this line: all below it is generated. -->"
DATA = (
    "`runs.csv.xz` has a row for each run, with its settings and facts as JSON; `metrics.csv.xz`, "
    "`training.csv.xz`, `cycles.csv.xz` and `levels.csv.xz` what was recorded at each evaluation, "
    "of the batches, by the curricula and on every single level at the end: "
    '`pandas.read_csv("metrics.csv.xz")`.'
)


def publish(
    folders: Sequence[Path],
    output: Path,
    threshold: float | None = None,
    baselines: Sequence[str] = (),
    compare: Sequence[str] = (),
) -> tuple[int, list[str]]:
    """Writes finished runs as a study; a report of it has the same tables as one of the runs.

    Args:
        folders: of runs or studies, or with some in them.
        output: folder to write to; of a study that is there, runs of the same names are replaced
            and the others stay.
        threshold: of the study's page, as for :func:`proposer_rl.report.build.write_report`.
        baselines: likewise.
        compare: likewise.

    Returns:
        How many runs were written, and a line for each that was left out.

    Raises:
        OutputError: if ``output`` has files in it and is no study, two runs have one name, or a
            label is unknown.
    """
    check_output(output, STUDY)
    found, notes = {}, []
    for name, runs in _named(folders).items():
        if all(run.finished for run in runs):
            found[name] = [_light(run) for run in runs]
        else:
            notes.append(f"left out: {name}: not finished")
    before = _named([output]) if (output / STUDY).exists() else {}
    every = {**before, **found}
    if found:
        output.mkdir(parents=True, exist_ok=True)
        write_study(output, [(name, run) for name in sorted(every) for run in every[name]])
        write_page(output, threshold, baselines, compare)
    return len(found), notes


def write_study(folder: Path, runs: Sequence[tuple[str, Run]]) -> None:
    """Writes the tables of a study in place of former ones."""
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
    written = {"runs": pd.DataFrame(listed), **tables(runs)}
    for name in NAMES:
        if name not in written:
            (folder / f"{name}.csv.xz").unlink(missing_ok=True)
    for name, table in reversed(written.items()):  # runs.csv.xz marks a study, so it comes last
        packed = lzma.compress(to_csv(table), preset=9)
        write_atomically(folder / f"{name}.csv.xz", packed)


def write_page(
    folder: Path,
    threshold: float | None = None,
    baselines: Sequence[str] = (),
    compare: Sequence[str] = (),
) -> None:
    """Writes a study's ``README.md`` and its figures from its tables.

    Text above :data:`MARK` is the authors' and stays.
    """
    studies, _ = read_checked([folder], threshold, baselines, compare)
    file, parts = folder / "README.md", []
    title = f"# {folder.name.replace('_', ' ').capitalize()}"
    above = file.read_text(encoding="utf-8").partition(MARK)[0] if file.is_file() else ""
    (folder / FIGURES).mkdir(exist_ok=True)
    compared = arena.arena(studies, baselines)
    if compared is not None:
        _draw(arena.differences(compared), folder, f"{FIGURES}/")
        parts.append(over_tasks(compared, f"{FIGURES}/"))
    for number, study in enumerate(studies):
        prefix = f"{FIGURES}/{f'{number + 1}_' if number else ''}"
        drawings = [each for each in (learning_curves(study), heat_maps(study)) if each]
        for drawing in drawings:
            _draw(drawing, folder, prefix)
        parts.append(section(study, prefix))
        parts += [f"![{each.title}]({prefix}{each.name}.png)" for each in drawings[1:]]
    command = report_command("bin/report", [folder], threshold, baselines, compare=compare)
    said = above.strip() or f"{title}\n\n{DATA}"
    text = document([said, MARK, *parts], anywhere(_from_here(command)), [])
    write_atomically(file, encoded(text))


def _draw(drawing: Drawing, folder: Path, prefix: str) -> None:
    (png,) = render(drawing, "png")
    write_atomically(folder / f"{prefix}{drawing.name}.png", in_few_colours(png))


def _named(folders: Sequence[Path]) -> dict[str, list[Run]]:
    """Returns the seeds of every run by its name, its path below the folder given."""
    found: dict[str, list[Run]] = {}
    for folder in map(Path.resolve, folders):
        for path in find_runs([folder]):
            own: dict[str, list[Run]] = {}
            for run in read_run(path):
                lies = run.folder.relative_to(path if (path / STUDY).exists() else folder)
                own.setdefault(lies.as_posix() if lies.parts else folder.name, []).append(run)
            for name, runs in own.items():
                if name in found:
                    places = f"{found[name][0].folder}, {runs[0].folder}"
                    raise OutputError(f"two runs have the name {name}: {places}")
                found[name] = runs
    return found


def _light(run: Run) -> Run:
    """Returns a run without pictures and this machine's folders, at six significant digits."""
    facts = {name: value for name, value in run.facts.items() if name != "final"}
    reused = str(run.config.get("checkpoint") or "")
    config, facts = (_anywhere(value, reused) for value in (run.config, facts))
    return replace(
        run,
        config=config,
        facts=facts,
        metrics=run.metrics.map(_six_digits),
        training=run.training.map(_six_digits),
        cycles=[_six_digits(cycle) for cycle in run.cycles],
        samples=(),
        levels={name: np.array(_six_digits([*column])) for name, column in run.levels.items()},
    )


def _six_digits(value: Any) -> Any:
    """Returns a value with all fractions in it at six significant digits; whole numbers stay."""
    if isinstance(value, float):
        return value if value.is_integer() else float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {name: _six_digits(each) for name, each in value.items()}
    return [_six_digits(each) for each in value] if isinstance(value, list) else value


def _anywhere(value: Mapping[str, Any], reused: str) -> dict[str, Any]:
    """Returns a mapping without this machine's folders.

    Paths inside the working folder, such as a repository's, become relative to it. Of the path of a
    checkpoint that was begun with the last two parts stay, which tell seeds of Proposers apart.
    """
    text = _from_here(json.dumps(dict(value)))
    if os.path.isabs(reused):
        text = text.replace(json.dumps(reused)[1:-1], "/".join(Path(reused).parts[1:][-2:]))
    found: dict[str, Any] = json.loads(anywhere(text))
    return found


def _from_here(text: str) -> str:
    """Returns a text with paths inside the working folder made relative to it."""
    return re.sub(rf"(?<![\w./]){re.escape(str(Path.cwd()))}/", "", text)
