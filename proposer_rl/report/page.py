"""The page: one study is one section, and the page holds all that it shows."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, StrictUndefined

from proposer_rl.report.findings import Finding
from proposer_rl.report.proposals import ANIMATION
from proposer_rl.report.records import level_text, words
from proposer_rl.report.runs import COST, Run
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import Drawing, Panel, data_uri, look, save_panel
from proposer_rl.report.tables import Table

PIXELS = 78  # of an inch of a figure
LONGEST_WORD = 2000  # of a command
WIDE = 7.0  # inches from which a panel is scrolled, not shrunk, on a phone
DASHES = {"-": "none", "--": "7 4", "-.": "7 3 2 3", ":": "2 3"}


class Section(NamedTuple):
    """All that the page shows of a study."""

    study: Study
    facts: Sequence[tuple[str, str]]
    unfinished: Sequence[str]
    overview: Table
    finding_note: str
    findings: Sequence[Finding]
    figures: Sequence[Mapping[str, Any]]
    tables: Sequence[Table]
    commands: Sequence[str]
    configs: Sequence[tuple[str, str]]


def render(title: str, command: str, sections: Sequence[Section], notes: Sequence[str]) -> str:
    """The page as HTML; whatever comes from a run is escaped."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = files(__package__).joinpath("page.html.j2").read_text(encoding="utf-8")
    page = environment.from_string(source)
    return page.render(title=title, command=command, sections=sections, notes=notes)


def figure(drawing: Drawing, animations: Mapping[str, bytes]) -> dict[str, Any]:
    """A figure as the page shows it: each panel an image of its own, so that they can wrap."""
    images = []
    for panel in drawing.panels:
        images.append(_image(panel))
        if panel.name in animations:
            images.append(_animation(animations[panel.name], panel))
    return {
        "title": drawing.title,
        "caption": drawing.caption,
        "images": images,
        "legend": [
            {"label": label, "colour": look(label).colour, "dash": DASHES[look(label).dash]}
            for label in drawing.labels
        ],
    }


def facts(study: Study) -> list[tuple[str, str]]:
    """What, with which versions, where, and how long."""
    runs = study.runs
    own, spent, evaluations = (
        sum(float(run.metrics[name][-1]) for run in runs) for name in COST[1:4]
    )
    seconds = sum(float(run.own_seconds[-1]) for run in runs)
    threshold = level_text(study.headline, study.threshold)
    return [
        (
            "Runs",
            f"{len(runs)}, of {len(study.groups)} methods or variants, compared at "
            f"{study.horizon} updates of the Solver",
        ),
        *study.example.task.about.items(),
        ("Threshold", f"{threshold} {words(study.headline)}"),
        ("Versions", _distinct(runs, _versions)),
        ("Hardware", _distinct(runs, _hardware)),
        *((group.label, group.setting) for group in study.groups if group.setting),
        (
            "Cost of all runs",
            f"{(own + spent) / 1e6:.1f} million environment frames ({spent / 1e6:.1f} of the "
            f"curricula), {evaluations:,.0f} evaluations of levels, {seconds:,.0f} s",
        ),
    ]


def unfinished(study: Study) -> list[str]:
    """Runs that are not at the end of their schedule."""
    return [
        f"{group.label} seed {run.seed} ({run.updates} updates)"
        for group in study.groups
        for run in group.runs
        if not run.finished
    ]


def commands(study: Study) -> list[str]:
    """What each group was started with; seeds that differ in nothing else in one command."""
    return [command for group in study.groups for command in _commands(group)]


def configs(study: Study) -> list[tuple[str, str]]:
    """The settings of each group's first run."""
    return [
        (group.label, _anywhere(json.dumps(group.runs[0].config, indent=1)[:20_000]))
        for group in study.groups
    ]


def _image(panel: Panel) -> dict[str, Any]:
    width, height = panel.size
    return {
        "address": data_uri(save_panel(panel), "image/svg+xml"),
        "description": panel.description,
        "width": round(width * PIXELS),
        "height": round(height * PIXELS),
        "wide": width >= WIDE,
    }


def _animation(content: bytes, panel: Panel) -> dict[str, Any]:
    height = round(panel.size[1] * PIXELS * 1.2)
    return {
        "address": data_uri(content, "image/gif"),
        "description": f"{panel.description} As an animation over all cycles.",
        "width": round(height * ANIMATION[0] / ANIMATION[1]),
        "height": height,
        "wide": False,
    }


def report_command(folders: Sequence[Path], threshold: float | None) -> str:
    """What writes this report again, without the places of this machine."""
    asked = [] if threshold is None else [f"--threshold={threshold:g}"]
    return _anywhere(shlex.join(["bin/report", *map(str, folders), *asked]))


def _commands(group: Group) -> list[str]:
    seeds: dict[str, list[int]] = {}
    for run in group.runs:
        seeds.setdefault(_command(run) or "", []).append(run.seed)
    return [
        f"{command} seed={','.join(map(str, with_them))}"
        if command
        else f"# {group.label}: the command was not recorded"
        for command, with_them in seeds.items()
    ]


def _command(run: Run) -> str | None:
    """What started a run, but for its seed; None where that is not known in full."""
    overrides, arguments = run.facts.get("overrides"), run.facts.get("arguments", {})
    if not isinstance(overrides, list) or not isinstance(arguments, dict):
        return None
    paths, config = arguments.get("pythonpath"), arguments.get("config_dir")
    own = ("seed=", "seeds=", "hydra.", "+sweep=", "progress=")
    words = [word for word in overrides if not (isinstance(word, str) and word.startswith(own))]
    if not all(
        isinstance(word, str) and word.isprintable() and len(word) <= LONGEST_WORD
        for word in (*words, paths or "", config or "")
    ):
        return None
    before = [f"PYTHONPATH={shlex.quote(_anywhere(paths))}"] if paths else []
    options = ["--config-dir", config, "-m"] if config else ["-m"]
    quoted = [shlex.quote(_anywhere(word)) for word in [*options, *words]]
    return " ".join([*before, "bin/train", *quoted])


def _anywhere(text: str) -> str:
    """Text without the folders of the machine it comes from: of a whole path the last part."""
    return re.sub(r"(?<![\w./])/(?:[\w.\-]+/)+", "", text)


def _versions(run: Run) -> str:
    found = run.facts.get("versions")
    if not isinstance(found, dict):
        return "not recorded"
    return ", ".join(f"{str(name)[:40]} {str(value)[:40]}" for name, value in found.items())


def _hardware(run: Run) -> str:
    facts = [run.facts.get(name) for name in ("machine", "device")]
    text = ", ".join(str(fact)[:120] for fact in facts if fact) or "not recorded"
    threads = run.facts.get("threads")
    return f"{text}, threads per operation: {threads}" if isinstance(threads, int) else text


def _distinct(runs: Sequence[Run], text: Any) -> str:
    return "; ".join(sorted({text(run) for run in runs}))
