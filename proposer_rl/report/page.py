"""Renders the page in HTML and its short form in Markdown, with a section for each study."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import math
import shlex
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, StrictUndefined
from PIL import Image

from proposer_rl.report import arena
from proposer_rl.report.outcomes import (
    Row,
    about_rows,
    answer,
    first_rows,
    first_table,
    group_table,
    meaning,
)
from proposer_rl.report.runs import COST, Run
from proposer_rl.report.statistics import ERROR
from proposer_rl.report.studies import Study
from proposer_rl.report.style import DPI, Drawing, in_few_colours
from proposer_rl.report.tables import Table, escape_markdown, write
from proposer_rl.runs.records import level_text, words

PIXELS = 78  # of an inch of a figure
WIDE = 140  # pixels of the dots of the first table
DIGIT = 6.5  # pixels of a character of their scale


Section = dict[str, Any]  # a section of the page, by the names in the template


def render(**content: Any) -> str:
    """Renders the page as HTML; text from runs is escaped or packed."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source, script = (
        files(__package__).joinpath(name).read_text(encoding="utf-8")
        for name in ("page.html.j2", "page.js")
    )
    library, packed = _library()
    return environment.from_string(source).render(
        content,
        script=script,
        library=packed,
        # The browser runs only these, even if other scripts had got into the page.
        allowed=" ".join(f"'{_digest(text)}'" for text in (script, library)),
    )


@cache
def _library() -> tuple[str, str]:
    """Returns the library of the charts, plain and packed; packing takes half a second."""
    from plotly.offline import get_plotlyjs  # large, and not needed for figures

    library = get_plotlyjs()
    return library, pack(library)


def pack(text: str) -> str:
    """Packs a text as gzip in base64, which cannot end the script element that holds it."""
    return base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()


def figure(drawing: Drawing, png: bytes) -> Section:
    """Returns a still figure as the page embeds it."""
    with Image.open(io.BytesIO(png)) as image:
        width = round(image.width * PIXELS / DPI)
    content = base64.b64encode(in_few_colours(png)).decode()
    return {
        "title": drawing.title,
        "caption": drawing.caption,
        "address": f"data:image/png;base64,{content}",
        "width": width,
    }


def methods(study: Study) -> list[tuple[str, str]]:
    """Returns the methods with their descriptions."""
    return [(group.label, meaning(group)) for group in study.groups]


def first(
    table: Table, rows: Sequence[Row], labels: Sequence[str], planned: Sequence[str]
) -> Section:
    """Returns the first table of a page: each method against the baseline, with its dot.

    Args:
        table: of these rows.
        rows: as :func:`proposer_rl.report.outcomes.first_rows` returns them.
        labels: of the methods in the order of the charts.
        planned: labels that are ticked.
    """
    ends = [0.0, *(end for row in rows for end in row.difference if end == end)]
    low, high = min(ends), max(ends)
    scale = (WIDE - 12) / ((high - low) or 1.0)

    def place(value: float) -> float:
        return round(6 + scale * (value - low), 1)

    found = []
    for row, texts in zip(rows, table.texts(), strict=True):
        value, *interval = map(place, row.difference)
        decision = row.decision
        alone = None if decision is None or math.isnan(decision.alone) else decision.alone
        now = decision is not None and row.asked and decision.p <= ERROR
        kind = decision and (decision.told if alone is None else decision.kind)(row.label)
        found.append(
            {
                "texts": texts,
                "value": row.difference.estimate,
                "dot": decision and value,
                "interval": None if alone is None else interval,
                "alone": alone,
                "kind": kind,
                "now": kind if now else "",
                "says": row.says,
                "number": labels.index(row.label) if row.label in labels else None,
                "ticked": row.label in planned,
            }
        )
    zero = place(0.0)
    return {
        "table": table,
        "rows": found,
        "wide": WIDE,
        "ticks": _ticks([(zero, "0"), (place(low), write(low)), (place(high), write(high))]),
        "zero": zero,
    }


def _ticks(wanted: Sequence[tuple[float, str]]) -> list[tuple[float, str]]:
    """Returns the numbers of a scale, with their centres, leaving out those that would overlap."""
    found: list[tuple[float, str]] = []
    for place, text in wanted:
        half = DIGIT * len(text) / 2
        centre = min(max(place, half), WIDE - half)
        if all(abs(centre - other) > half + DIGIT * (len(t) / 2 + 1) for other, t in found):
            found.append((centre, text))
    return found


def first_of_study(study: Study) -> Table:
    """Returns the first table of a study."""
    shown = f"updates to {level_text(study.headline, study.threshold)}"
    return first_table(first_rows(study), study.baseline.label, shown, about_rows(study))


def first_of_tasks(compared: arena.Arena) -> Table:
    """Returns the first table over several tasks."""
    about, baseline = arena.about_rows(compared), compared.baselines[0]
    return first_table(compared.rows, baseline, "reached", about, "arena_baseline")


def facts(study: Study) -> list[tuple[str, str]]:
    """Returns facts on the comparison, as labels and texts."""
    threshold = level_text(study.headline, study.threshold)
    return [
        (
            "Runs",
            f"{len(study.runs)}, of {len(study.groups)} methods or variants, compared at "
            f"{study.horizon} updates of the Solver",
        ),
        *study.example.task.about.items(),
        ("Threshold", f"{threshold} {words(study.headline)}"),
    ]


def origin(study: Study) -> list[tuple[str, str]]:
    """Returns software, hardware and total cost of the runs, as labels and texts."""
    runs = study.runs
    own, spent, evaluations = (sum(run.last(name) for run in runs) for name in COST[1:4])
    seconds = sum(run.own_seconds[-1] for run in runs)
    return [
        ("Versions", _distinct(runs, _versions)),
        ("Hardware", _distinct(runs, _hardware)),
        (
            "Cost of all runs",
            f"{(own + spent) / 1e6:.1f} million environment frames ({spent / 1e6:.1f} of the "
            f"curricula), {evaluations:,.0f} evaluations of levels, {seconds:,.0f} s",
        ),
    ]


def incomplete(study: Study) -> list[str]:
    """Returns the names of runs that are unfinished or shorter than the horizon."""
    return [
        f"{group.label} seed {run.seed} ({run.updates} updates)"
        for group in study.groups
        for run in group.runs
        if not run.finished or run.updates < study.horizon
    ]


def commands(study: Study) -> list[str]:
    """Returns the command of each group; one for all seeds that differ in nothing else.

    Seeds that were trained side by side stay together, since on some tasks they draw other numbers
    alone.
    """
    found = []
    for group in study.groups:
        seeds: dict[str, list[int]] = {}
        for run in group.runs:
            seeds.setdefault(_command(run), []).append(run.seed)
        for command, own in seeds.items():
            if not command:
                found.append(f"# {group.label}: the command was not recorded")
            else:
                found.append(f"{command}{_joined(own)}" if command.endswith("=") else command)
    return found


def _digest(script: str) -> str:
    """Returns the hash that lets a script run under the page's Content-Security-Policy."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}"


def report_command(
    program: str,
    folders: Sequence[Path],
    threshold: float | None,
    baselines: Sequence[str],
    *more: str,
    compare: Sequence[str] = (),
) -> str:
    """Returns the command that writes this report again, from the same folder."""
    asked = [] if threshold is None else [f"--threshold={threshold:g}"]
    asked += [f"--baseline={baseline}" for baseline in baselines]
    asked += [f"--compare={','.join(compare)}"] if compare else []
    return f"{program} {shlex.join([*map(str, folders), *asked, *more])}"


def _command(run: Run) -> str:
    """Returns a run's command, ending in ``seed=`` if it had one seed; empty if not recorded."""
    words = run.facts.get("overrides") or []
    # A custom task or curriculum that was passed to prl.train is in no override.
    if "~task" in words or not any(word.lstrip("+").startswith("method=") for word in words):
        return ""
    if isinstance(settings := run.facts.get("settings"), dict):  # of prl.train
        named: dict[str, Any] = dict(word.lstrip("+").split("=", 1) for word in words)
        named.pop("seed", None)
        given = {"task": named.pop("task", ""), "curriculum": named.pop("method"), **named}
        given["settings"] = {k: v for k, v in settings.items() if k not in ("seed", "compute")}
        call = ", ".join(f"{name}={value!r}" for name, value in given.items())
        return f"prl.train({call}{')' if run.shared_by > 1 else ', seed=seed)  # seed='}"
    arguments = run.facts.get("arguments", {})
    paths, config = arguments.get("pythonpath"), arguments.get("config_dir")
    own = ("seed=", "seeds=", "hydra.", "+sweep=", "compute.", "logger")
    shown = [word for word in words if not word.startswith(own)]
    many, seeds = ["-m"], "seed="
    if run.shared_by > 1:
        many, seeds = [], f"seeds=[{_joined(run.config['seeds'])}]"
    before = [f"PYTHONPATH={shlex.quote(paths)}"] if paths else []
    options = ["--config-dir", config] if config else []
    quoted = [shlex.quote(word) for word in [*options, *many, *shown, seeds]]
    return " ".join([*before, "bin/train", *quoted])


def _joined(seeds: Sequence[int]) -> str:
    return ",".join(map(str, seeds))


def _versions(run: Run) -> str:
    found = run.facts.get("versions", {})
    return ", ".join(f"{name} {found[name]}" for name in sorted(found)) or "not recorded"


def _hardware(run: Run) -> str:
    facts = [run.facts.get(name) for name in ("machine", "device")]
    text = ", ".join(filter(None, facts)) or "not recorded"
    threads = run.facts.get("threads")
    return f"{text}, threads per operation: {threads}" if threads else text


def _distinct(runs: Sequence[Run], text: Any) -> str:
    return "; ".join(sorted({text(run) for run in runs}))


def section(study: Study, figures: str) -> str:
    """Renders a study in Markdown: the answer, the tables, the runs."""
    about = facts(study) + origin(study)
    if short := incomplete(study):
        text = f"Not finished, or shorter than {study.horizon} updates"
        about = [*about, (text, ", ".join(short))]
    made = "\n".join(commands(study))
    return "\n\n".join(
        [
            f"## {escape_markdown(study.title)}",
            "\n".join(f"- {escape_markdown(sentence)}" for sentence in answer(study)),
            *_tables([first_of_study(study)]),
            f"![Learning curves and updates to the threshold]({figures}learning_curves.png)",
            *_tables([group_table(study)]),
            "### Runs and commands",
            "\n".join(f"- {escape_markdown(f'{name}: {text}')}" for name, text in about),
            f"```bash\n{made}\n```",
        ]
    )


def over_tasks(compared: arena.Arena, figures: str) -> str:
    """Renders the comparison over several tasks in Markdown."""
    drawing = arena.differences(compared)
    summary, by_task = arena.summary(compared), arena.task_table(compared)
    picture = f"![{escape_markdown(drawing.title)}]({figures}{drawing.name}.png)"
    said = "\n".join(f"- {escape_markdown(sentence)}" for sentence in arena.answer(compared))
    first = _tables([first_of_tasks(compared), summary])
    return "\n\n".join(["## Over all tasks", said, *first, picture, *_tables([by_task])])


def of_teachers(drawings: Sequence[Drawing], notes: Sequence[str], figures: str) -> str:
    """Renders the logs of teachers in Markdown."""
    pictures = [f"![{escape_markdown(one.title)}]({figures}{one.name}.png)" for one in drawings]
    return "\n\n".join(["## Logs of teachers", *map(escape_markdown, notes), *pictures])


def _tables(tables: Iterable[Table]) -> list[str]:
    parts = []
    for table in tables:
        if table.rows:
            text = table.to_markdown().strip()
            parts += [f"### {escape_markdown(table.title)}", text, escape_markdown(table.note)]
    return parts


def document(parts: Sequence[str], command: str, notes: Sequence[str]) -> str:
    """Joins parts, notes and the command that writes them into a Markdown page."""
    left_out = "\n".join(f"- {escape_markdown(note)}" for note in notes)
    made = f"The whole report is written by\n\n```bash\n{command}\n```"
    return "\n\n".join(filter(None, [*parts, left_out, made])) + "\n"
