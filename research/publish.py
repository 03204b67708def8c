"""Finished runs as a study: a folder of a few tables, small enough for a repository.

Checkpoints, pictures of levels and this machine's folders are left out, and fractions have six
significant digits. A study is read as runs are, by ``bin/report`` and ``bin/research pages``.
"""

from __future__ import annotations

import argparse
import json
import lzma
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from proposer_rl.cli.errors import command
from proposer_rl.report import arena
from proposer_rl.report.figures import heat_maps, learning_curves
from proposer_rl.report.page import document, over_tasks, report_command, section
from proposer_rl.report.reading import OutputError, find_runs, read_run
from proposer_rl.report.runs import NAMES, STUDY, Run, tables, to_csv
from proposer_rl.report.studies import read_studies
from proposer_rl.report.style import Drawing, in_few_colours, render
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.records import anywhere, encoded, printable

MARK = "<!-- All below is written by bin/research publish. -->"
DATA = (
    "`runs.csv.xz` has a row for each run, with its settings and facts as JSON; `metrics.csv.xz`, "
    "`training.csv.xz`, `cycles.csv.xz` and `levels.csv.xz` what was recorded at each evaluation, "
    "of the batches, by the curricula and on every single level at the end: "
    '`pandas.read_csv("metrics.csv.xz")`.'
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    command(partial(_run, _parser().parse_args(arguments)))


def _run(options: argparse.Namespace) -> None:
    written, left_out = publish(options.folder, options.output)
    print(*map(printable, [*left_out, f"Runs: {written} in {options.output}"]), sep="\n")


def publish(folders: Sequence[Path], output: Path) -> tuple[int, list[str]]:
    """Write finished runs as a study. Tables come out of it as they do of the runs.

    Args:
        folders: of runs or studies, or with some in them.
        output: folder to write to; of a study that is there, runs of the same names are replaced
            and the others stay.

    Returns:
        How many runs were written, and a line for each that was left out.
    """
    occupied = output.is_dir() and any(output.iterdir()) and not (output / STUDY).is_file()
    if (output.exists() and not output.is_dir()) or occupied:
        raise OutputError(f"-o {output}: is no study; give a new folder")
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
        write_page(output)
    return len(found), notes


def write_study(folder: Path, runs: Sequence[tuple[str, Run]]) -> None:
    """Write the tables of a study; those of a former one are replaced."""
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
    for name, table in reversed(written.items()):  # what makes it a study comes last
        packed = lzma.compress(to_csv(table), preset=9)
        write_atomically(folder / f"{name}.csv.xz", packed)


def write_page(folder: Path) -> None:
    """Write a study's ``README.md`` and its figures from its tables.

    What the page says above :data:`MARK` is its authors' and stays.
    """
    studies, _ = read_studies([folder], None)
    file, parts = folder / "README.md", []
    title = f"# {folder.name.replace('_', ' ').capitalize()}"
    above = file.read_text(encoding="utf-8").partition(MARK)[0] if file.is_file() else ""
    compared = arena.arena(studies)
    (folder / "figures").mkdir(exist_ok=True)
    if compared is not None:
        drawing = arena.differences(compared)
        write_atomically(folder / f"figures/{drawing.name}.png", _picture(drawing))
        parts.append(over_tasks(compared, "figures/"))
    for number, study in enumerate(studies):
        prefix = f"figures/{f'{number + 1}_' if number else ''}"
        drawings = [each for each in (learning_curves(study), heat_maps(study)) if each]
        for drawing in drawings:
            write_atomically(folder / f"{prefix}{drawing.name}.png", _picture(drawing))
        parts.append(section(study, prefix))
        parts += [f"![{each.title}]({prefix}{each.name}.png)" for each in drawings[1:]]
    command = anywhere(_from_here(report_command("bin/report", [folder], None, ())))
    said = above.strip() or f"{title}\n\n{DATA}"
    write_atomically(file, encoded(document([said, MARK, *parts], command, [])))


def _picture(drawing: Drawing) -> bytes:
    (png,) = render(drawing, "png")
    return in_few_colours(png)


def _named(folders: Sequence[Path]) -> dict[str, list[Run]]:
    """The seeds of every run by its name: where it lies below the folder that was given."""
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
                    raise OutputError(f"two runs are called {name}: {places}")
                found[name] = runs
    return found


def _light(run: Run) -> Run:
    """A run without pictures, without this machine's folders, and of six significant digits."""
    facts = {name: value for name, value in run.facts.items() if name != "final"}
    facts["task"] = {name: value for name, value in facts["task"].items() if name != "samples"}
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
        sheets={},
    )


def _six_digits(value: Any) -> Any:
    """A value with all fractions in it at six significant digits; whole numbers stay."""
    if isinstance(value, float):
        return value if value.is_integer() else float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {name: _six_digits(each) for name, each in value.items()}
    return [_six_digits(each) for each in value] if isinstance(value, list) else value


def _anywhere(value: Mapping[str, Any], reused: str) -> dict[str, Any]:
    """A mapping without this machine's folders; of a checkpoint begun with its last two parts.

    Paths inside the working folder, such as a repository's, are those from there.

    Seeds of Proposers are called by the folders above those of their last Solvers.
    """
    text = _from_here(json.dumps(dict(value)))
    if os.path.isabs(reused):
        text = text.replace(json.dumps(reused)[1:-1], "/".join(Path(reused).parts[1:][-2:]))
    found: dict[str, Any] = json.loads(anywhere(text))
    return found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="bin/research publish", description=__doc__)
    parser.add_argument("folder", nargs="+", type=Path, help="of runs or studies")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the study's folder")
    return parser


def _from_here(text: str) -> str:
    """Text with paths inside the working folder made relative to it."""
    return re.sub(rf"(?<![\w./]){re.escape(str(Path.cwd()))}/", "", text)


if __name__ == "__main__":
    main()
