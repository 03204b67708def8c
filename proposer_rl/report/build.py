"""Writes a report on runs: a page, figures and tables."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from proposer_rl.report import arena, figures, outcomes, page, runs, teachers
from proposer_rl.report.charts import charts
from proposer_rl.report.outcomes import answer
from proposer_rl.report.reading import OutputError, begun, find_runs
from proposer_rl.report.statistics import FEWEST, HELD
from proposer_rl.report.studies import Study, read_studies
from proposer_rl.report.style import Drawing, render
from proposer_rl.report.tables import Table
from proposer_rl.runs.folder import can_reach, is_rate, write_atomically
from proposer_rl.runs.records import encoded, words

PAGE = "report.html"
LOG = ".jsonl"  # the suffix of teachers' logs
FIGURES, TABLES = "figures", "tables"

DRAWINGS: Sequence[Callable[[Study], Drawing | None]] = (
    figures.learning_curves,
    figures.heat_maps,
)


def read_checked(
    folders: Sequence[Path],
    threshold: float | None,
    baselines: Sequence[str],
    compare: Sequence[str] = (),
) -> tuple[list[Study], list[str]]:
    """Reads runs into studies, with notes on what was left out, and checks what was asked for."""
    first, found = next(iter(baselines), None), find_runs(folders)
    studies, notes = read_studies(found, threshold, first, compare)
    every = dict.fromkeys(path for folder in folders for path in begun(folder))
    unmeasured = [path for path in every if path not in found]
    notes += [f"not read: {path.name}: it has measured nothing" for path in unmeasured]
    labels = sorted({group.label for study in studies for group in study.compared})
    for option, given in (("baseline", baselines), ("compare", compare)):
        for label in given:
            if label not in labels:
                raise OutputError(f"--{option}={label}: must be one of {'; '.join(labels)}")
    for study in studies:
        if threshold is not None and not can_reach(study.headline, threshold):
            raise OutputError(f"--threshold={threshold:g}: must be above 0 and at most 1")
    return studies, notes


def write_report(
    folders: Sequence[Path],
    output: Path,
    threshold: float | None = None,
    baselines: Sequence[str] = (),
    compare: Sequence[str] = (),
) -> Path:
    """Writes a report and returns the path of its page.

    Args:
        folders: run folders or folders that contain some; or files of ``teacher.log``, ``*.jsonl``.
        output: folder to write to; a report in it is replaced, and other files stay.
        threshold: of the headline measurement, in place of the runs' own.
        baselines: labels of the methods that others are compared with: on each task the first, and
            over several tasks the best of them. The default is ``domain_randomization`` or, where
            that is missing, the first method; over several tasks ``domain_randomization`` and
            ``target``.
        compare: labels of the methods whose comparison was planned, for which alone p-values are
            corrected; by default all methods.
    """
    check_output(output, PAGE)
    logs = [path for path in folders if path.suffix == LOG]
    curves, of_teachers = teachers.read_curves(logs)
    of_runs = [path for path in folders if path.suffix != LOG]
    studies, notes = read_checked(of_runs, threshold, baselines, compare) if of_runs else ([], [])
    files: dict[str, bytes] = {}
    sections: list[page.Section] = []
    title = "Curricula: what the runs show"
    parts = [f"# {title}", f"The whole report is [{PAGE}]({PAGE}), one file for a browser."]
    over_tasks, compared = None, arena.arena(studies, baselines)
    if compared is not None:
        over_tasks = _over_tasks(compared, files)
        parts.append(page.over_tasks(compared, f"{FIGURES}/"))
    for study in studies:
        prefix = f"{_slug(study.title)}_" if len(studies) > 1 else ""
        if f"{TABLES}/{prefix}methods.csv" in files:  # same title, other measurements
            prefix += f"{len(sections) + 1}_"
        sections.append(_section(study, prefix, files))
        parts.append(page.section(study, f"{FIGURES}/{prefix}"))
    told: page.Section | None = None
    if curves:
        drawings = teachers.drawings(curves)
        still = [page.figure(one, _drawn(one, "", files)) for one in drawings]
        told = {"notes": of_teachers, "figures": still}
        parts.append(page.of_teachers(drawings, of_teachers, f"{FIGURES}/"))
    command = page.report_command("bin/report", folders, threshold, baselines, compare=compare)
    html = page.render(
        title=title,
        command=command,
        sections=sections,
        notes=notes,
        arena=over_tasks,
        teachers=told,
    )
    files["report.md"] = encoded(page.document(parts, command, notes))
    for path in (output / FIGURES, output / TABLES):  # remove what a former report left
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.mkdir(parents=True)
    for name, content in {**files, PAGE: encoded(html)}.items():
        write_atomically(output / name, content)
    return output / PAGE


def check_output(output: Path, *signs: str) -> None:
    """Refuses an output folder that has files in it but none of a former output."""
    occupied = output.exists() and any(output.iterdir())
    if occupied and not any((output / sign).is_file() for sign in signs):
        raise OutputError(
            f"{output}: is not empty, and has no {' or '.join(signs)}; use a new directory, or one "
            "that this command has written"
        )


def _over_tasks(compared: arena.Arena, files: dict[str, bytes]) -> page.Section:
    """Returns the page's section on several tasks, and adds its files to ``files``."""
    first = page.first_of_tasks(compared)
    tables = [arena.summary(compared), arena.task_table(compared)]
    _add([first, *tables], "", files)
    planned = [label for study in compared.tasks.values() for label in study.planned]
    drawing = arena.differences(compared)
    return {
        "answer": arena.answer(compared),
        "first": page.first(first, compared.rows, (), planned),
        "summary": tables[0],
        "tasks": tables[1],
        "figure": page.figure(drawing, _drawn(drawing, "", files)),
    }


def _drawn(drawing: Drawing, prefix: str, files: dict[str, bytes]) -> bytes:
    """Returns a figure as PNG, and adds its files to ``files``."""
    svg, png = render(drawing, "svg", "png")
    path = f"{FIGURES}/{prefix}{drawing.name}"
    files |= {f"{path}.svg": svg, f"{path}.png": png}
    return png


def _add(tables: Sequence[Table], prefix: str, files: dict[str, bytes]) -> None:
    for table in tables:
        files[f"{TABLES}/{prefix}{table.name}.csv"] = encoded(table.to_csv())
        files[f"{TABLES}/{prefix}{table.name}.md"] = encoded(table.to_markdown())


def _section(study: Study, prefix: str, files: dict[str, bytes]) -> page.Section:
    """Returns the page's section on a study, and adds its files to ``files``."""
    methods = outcomes.group_table(study)
    pairs = outcomes.comparison_table(study)
    first, labels = page.first_of_study(study), [group.label for group in study.groups]
    _add([first, methods, pairs], prefix, files)
    named = [(group.label, run) for group in study.groups for run in group.runs]
    rows = runs.tables(named, "method")
    files |= {f"{TABLES}/{prefix}{name}.csv": runs.to_csv(own) for name, own in rows.items()}
    for draw in DRAWINGS:
        if drawing := draw(study):
            _drawn(drawing, prefix, files)
    data = charts(study)
    return {
        "study": study,
        "headline": words(study.headline),
        "answer": answer(study),
        "first": page.first(first, outcomes.first_rows(study), labels, study.planned),
        "rate": is_rate(study.headline),
        "few": FEWEST,
        "held": f"{HELD:.0%}",
        "facts": page.facts(study),
        "origin": page.origin(study),
        "incomplete": page.incomplete(study),
        "meanings": page.methods(study),
        "data": page.pack(json.dumps(data, allow_nan=False, separators=(",", ":"))),
        "staged": data["stages"] is not None,
        "methods": methods,
        "pairs": pairs,
        "commands": page.commands(study),
    }


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_").lower()[:80]
