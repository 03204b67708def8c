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
from proposer_rl.report.outcomes import words
from proposer_rl.report.proposals import ANIMATION
from proposer_rl.report.runs import Run
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import Drawing, Panel, data_uri, look, save_panel
from proposer_rl.report.tables import Table

PIXELS = 78  # of an inch of a figure
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
    config = study.example.config
    measured = ", ".join(
        f"{name.upper()} {_specification(config['distributions'][name])}" for name in study.measured
    )
    seconds = sum(float(run.own_seconds[-1]) for run in runs)
    copies = sum(float(run.metrics["meta_frames"][-1]) for run in runs)
    own = sum(float(run.metrics["frames"][-1]) for run in runs)
    return [
        (
            "Runs",
            f"{len(runs)}, of {len(study.groups)} methods or variants, compared at "
            f"{study.horizon} updates of the Solver",
        ),
        (
            "Mazes",
            f"{config['maze']['height']}×{config['maze']['width']}, at most "
            f"{config['maze'].get('max_steps', '?')} steps",
        ),
        ("Measured on", f"{measured}; {config['evaluation'].get('levels', '?')} fixed levels each"),
        ("Threshold", f"{study.threshold:.0%} {words(study.headline)}"),
        ("Versions", _distinct(runs, _versions)),
        ("Hardware", _distinct(runs, _hardware)),
        *((group.label, group.setting) for group in study.groups if group.setting),
        (
            "Cost of all runs",
            f"{(own + copies) / 1e6:.1f} million environment frames "
            f"({copies / 1e6:.1f} of copies), {seconds:,.0f} s",
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
    own = ("seed=", "seeds=", "hydra.", "+sweep=", "progress=")
    seeds: dict[tuple[str, ...], list[int]] = {}
    for run in group.runs:
        overrides = run.facts.get("overrides")
        if not isinstance(overrides, list):
            return [f"# {group.label}: the command was not recorded"]
        words = [_anywhere(str(word)[:200]) for word in overrides if not str(word).startswith(own)]
        seeds.setdefault(tuple(words), []).append(run.seed)
    return [
        " ".join(
            ["bin/train -m", *map(shlex.quote, words), f"seed={','.join(map(str, with_them))}"]
        )
        for words, with_them in seeds.items()
    ]


def _anywhere(text: str) -> str:
    """Text without the folders of the machine it comes from: of a whole path the last part."""
    return re.sub(r"(?<![\w./])/(?:[\w.\-]+/)+", "", text)


def _specification(distribution: Mapping[str, Any]) -> str:
    pairs = [
        f"{fraction:g} obstacles, path of {length}"
        for fraction, length in distribution["specifications"][:4]
    ]
    return f"({'; '.join(pairs)}; {distribution.get('mechanism', '?')})"


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
