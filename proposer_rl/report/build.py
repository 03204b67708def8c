"""From folders of runs to a folder with the evidence: page, figures, tables."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from proposer_rl.report import curves, levels, outcomes, page, proposals
from proposer_rl.report.findings import finding_table, findings
from proposer_rl.report.runs import find_runs
from proposer_rl.report.studies import Study, read_studies
from proposer_rl.report.style import Drawing, save
from proposer_rl.report.tables import escape_markdown, to_csv
from proposer_rl.runs.folder import write_atomically

PAGE = "report.html"
FIGURES, TABLES = "figures", "tables"

# In the order of the page.
DRAWINGS: Sequence[Callable[[Study], Drawing | None]] = (
    curves.learning_curves,
    curves.cost_curves,
    curves.worst_levels,
    curves.difficulty,
    proposals.gains,
    proposals.heat_maps,
    levels.along_training,
    levels.side_by_side,
    proposals.diagnostics,
)


class OutputError(ValueError):
    """The output folder cannot be taken; the message is one line."""


class _Content(NamedTuple):
    """A study's part of the report: its section, and files by their path in the folder."""

    section: page.Section
    files: dict[str, bytes]


def write_report(
    folders: Sequence[Path], output: Path, threshold: float | None = None, progress: bool = True
) -> Path:
    """Write a report.

    Args:
        folders: of runs, or with runs in them.
        output: folder to write to; a report in it is replaced, other files stay.
        threshold: of the headline measurement, in place of the runs' own.
        progress: whether to draw a progress bar.

    Returns:
        The page.

    Raises:
        UnreadableRun: if a folder has no run, or none can be read.
        OutputError: if the output folder holds something that is no report.
    """
    _check_output(output)
    studies, notes = read_studies(find_runs(folders), threshold)
    steps = sum(len(DRAWINGS) + 1 for _ in studies)
    bar = tqdm(total=steps, desc="Report", disable=not progress, leave=False)
    with bar:
        contents = [
            _content(study, f"{_slug(study.title)}_" if len(studies) > 1 else "", bar)
            for study in studies
        ]
    title = "Curricula: what the runs show"
    command = page.report_command(folders, threshold)
    html = page.render(title, command, [content.section for content in contents], notes)
    files = {name: data for content in contents for name, data in content.files.items()}
    files["report.md"] = _markdown(title, command, contents).encode()
    _write(output, files)
    write_atomically(output / PAGE, html.encode())
    return output / PAGE


def _check_output(output: Path) -> None:
    if output.exists() and not output.is_dir():
        raise OutputError(f"{output}: is a file; give a folder for the report")
    occupied = output.is_dir() and any(output.iterdir())
    if occupied and not (output / PAGE).is_file():
        raise OutputError(
            f"{output}: has files in it but no {PAGE}; give a new folder or one of a report"
        )


def _content(study: Study, prefix: str, bar: tqdm) -> _Content:
    files: dict[str, bytes] = {}
    bar.set_postfix_str("statistics")
    found = findings(study)
    tables = [
        outcomes.group_table(study),
        outcomes.comparison_table(list(outcomes.comparisons(study))),
        outcomes.run_table(study),
    ]
    for table in (*tables, finding_table(found)):
        files[f"{TABLES}/{prefix}{table.name}.csv"] = table.to_csv().encode()
        files[f"{TABLES}/{prefix}{table.name}.md"] = table.to_markdown().encode()
    for name, tidy in (("metrics", outcomes.tidy_metrics), ("cycles", outcomes.tidy_cycles)):
        header, rows = tidy(study)
        if rows:
            files[f"{TABLES}/{prefix}{name}.csv"] = to_csv(header, rows).encode()
    bar.update()
    figures = []
    for draw in DRAWINGS:
        bar.set_postfix_str(draw.__name__.replace("_", " "))
        drawing = draw(study)
        if drawing is not None:
            animations = _animations(study) if draw is proposals.heat_maps else {}
            figures.append(page.figure(drawing, animations))
            files |= dict(_figure_files(drawing, animations, prefix))
        bar.update()
    section = page.Section(
        study=study,
        facts=page.facts(study),
        unfinished=page.unfinished(study),
        overview=tables[0],
        finding_note=finding_table(found).note,
        findings=found,
        figures=figures,
        tables=tables[1:],
        commands=page.commands(study),
        configs=page.configs(study),
    )
    return _Content(section, files)


def _animations(study: Study) -> dict[str, bytes]:
    found = {group.label: proposals.animate(group) for group in study.groups}
    return {label: content for label, content in found.items() if content is not None}


def _figure_files(
    drawing: Drawing, animations: dict[str, bytes], prefix: str
) -> Iterator[tuple[str, bytes]]:
    for suffix, content in save(drawing).items():
        yield f"{FIGURES}/{prefix}{drawing.name}.{suffix}", content
    for label, content in animations.items():
        yield f"{FIGURES}/{prefix}{drawing.name}_{_slug(label)}.gif", content


def _write(output: Path, files: dict[str, bytes]) -> None:
    """Replace the report's files; those of a former report that are no more are removed."""
    for folder in (FIGURES, TABLES):
        path = output / folder
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.mkdir(parents=True)
    for name, content in files.items():
        write_atomically(output / name, content)


def _markdown(title: str, command: str, contents: Sequence[_Content]) -> str:
    """The report in short, for where HTML is not shown."""
    parts = [f"# {title}\n", f"The whole report is [{PAGE}]({PAGE}), one file for a browser."]
    parts += ["It is written by\n", f"```bash\n{command}\n```\n"]
    for content in contents:
        section = content.section
        parts += [f"## {section.study.title}\n"]
        parts += [
            f"- {escape_markdown(name)}: {escape_markdown(value)}" for name, value in section.facts
        ]
        for name in sorted(content.files):
            if name.endswith("learning_curves.png"):
                parts.append(f"\n![Learning curves and updates to the threshold]({name})\n")
        for table in (finding_table(section.findings), section.overview):
            parts += [f"### {table.title}\n", f"{table.note}\n", table.to_markdown()]
        parts += ["### Commands\n", "```bash", *section.commands, "```\n"]
    return "\n".join(parts)


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_").lower()[:80]
