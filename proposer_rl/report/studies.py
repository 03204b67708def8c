"""Sorts runs into comparable studies, and these into groups that differ only in the seed."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from proposer_rl.report.reading import UnreadableRun, read_run
from proposer_rl.report.runs import Run
from proposer_rl.report.style import Look, looks
from proposer_rl.runs.records import natural

USUAL_BASELINE = "domain_randomization"
LONGEST_LABEL = 40  # characters of the settings in a label
# Beginnings of overrides that do not make a run another variant.
ASIDE = (
    "method=", "ablation=", "scale=", "seed=", "seeds=", "sweep=", "schedule.", "checkpoint=",
    "compute.", "logger", "hydra.",
)  # fmt: skip

# The seed in a folder's name, alone or at the end as in sweeps.
_SEED_OF_A_FOLDER = re.compile(r"(?:(?<=seed_)|(?<![^/]))[0-9]+(?![^/])")


@dataclass(frozen=True)
class Group:
    """Runs of one method with the same settings and different seeds.

    Attributes:
        label: its name in this report.
        runs: in the order of their seeds.
        setting: the settings that tell it from other groups of the method; empty for a lone one.
        look: in figures.
    """

    label: str
    runs: tuple[Run, ...]
    setting: str = ""
    look: Look = field(default_factory=lambda: Look("black"))

    @property
    def seeds(self) -> list[int]:
        """The runs' seeds."""
        return [run.seed for run in self.runs]

    @property
    def logs(self) -> list[Run]:
        """The runs with cycles of their own; seeds that were trained together may share them."""
        return list({run.whose_cycles: run for run in self.runs if run.cycles}.values())


@dataclass(frozen=True)
class Study:
    """Groups with the same measurements on the same task.

    Attributes:
        title: the scale and the task.
        groups: the methods and variants, in the order of their labels.
        threshold: of the headline measurement.
        chosen: the label of the baseline that was asked for.
        planned: labels of the methods to compare; empty for all.
        timed: the machine on which all methods were timed in turns; None where seconds are those of
            the runs.
    """

    title: str
    groups: tuple[Group, ...]
    threshold: float
    chosen: str | None = None
    planned: tuple[str, ...] = ()
    timed: str | None = None

    @property
    def runs(self) -> list[Run]:
        """The runs of all groups."""
        return [run for group in self.groups for run in group.runs]

    @property
    def example(self) -> Run:
        """A run, which stands for what all have in common."""
        return self.groups[0].runs[0]

    @property
    def headline(self) -> str:
        """The measurement by which runs are compared."""
        return self.example.headline

    @property
    def measurements(self) -> list[str]:
        """Columns of the distributions that were measured on, one for each."""
        return self.example.measurements

    @cached_property
    def horizon(self) -> int:
        """The number of updates at which runs are compared, that of most finished runs."""
        lengths = Counter(run.updates for run in self.runs if run.finished)
        if not lengths:
            return max(run.updates for run in self.runs)
        return max(lengths, key=lambda length: (lengths[length], length))

    @cached_property
    def compared(self) -> list[Group]:
        """Groups with those of their runs that are as long as the horizon, up to it."""
        found = []
        for group in self.groups:
            long = [run for run in group.runs if run.updates >= self.horizon]
            if long:
                found.append(replace(group, runs=tuple(run.until(self.horizon) for run in long)))
        return found

    @property
    def legend(self) -> dict[str, Look]:
        """The groups' looks by their labels."""
        return {group.label: group.look for group in self.groups}

    @property
    def baseline(self) -> Group:
        """The group that others are compared with: the chosen one, the usual one, or the first.

        If the usual one is not among the planned methods, it is the last of them.
        """
        usual = USUAL_BASELINE if USUAL_BASELINE in (self.planned or [USUAL_BASELINE]) else ""
        found = map(self.group, [self.chosen or "", usual, *reversed(self.planned)])
        return next(filter(None, found), self.compared[0])

    @property
    def asked(self) -> list[Group]:
        """The groups that are tested against each other: the planned ones and the baseline."""
        labels = {*self.planned, self.baseline.label}
        return [group for group in self.compared if not self.planned or group.label in labels]

    def group(self, label: str) -> Group | None:
        """Returns the compared group of that label; None if it is not there."""
        return next((group for group in self.compared if group.label == label), None)


def read_studies(
    folders: Iterable[Path],
    threshold: float | None,
    baseline: str | None = None,
    planned: Sequence[str] = (),
) -> tuple[list[Study], list[str]]:
    """Reads runs and sorts them into studies.

    Returns:
        The studies, the largest first, and a line for each folder that was left out.
    """
    runs: list[Run] = []
    notes: list[str] = []
    first = "no folders"
    for folder in folders:
        try:
            runs += read_run(folder)
        except UnreadableRun as error:
            first = str(error) if not notes else first
            notes.append(f"not read: {folder.name}: {str(error).removeprefix(f'{folder}: ')}")
    if not runs:
        raise UnreadableRun(first)
    runs, doubles = _without_doubles(runs)
    alike: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        alike[_key(_setting(run))].append(run)
    grouped = [(members[0], _groups(members)) for members in alike.values()]
    every = looks(group.label for _, groups in grouped for group in groups)
    studies = [
        Study(
            _title(example),
            tuple(replace(group, look=every[group.label]) for group in groups),
            float(example.config["schedule"]["threshold"]) if threshold is None else threshold,
            baseline,
            tuple(planned),
        )
        for example, groups in grouped
    ]
    return sorted(studies, key=lambda study: -len(study.runs)), notes + doubles


def _setting(run: Run) -> dict[str, Any]:
    """Returns everything that must be equal for two runs to be measured alike."""
    return {
        "scale": run.config.get("scale"),
        "measured": run.task.measured,
        "columns": run.measurements,
        "headline": [run.config["schedule"][key] for key in ("headline", "threshold")],
    }


def _variant(run: Run) -> dict[str, Any]:
    """Returns everything that a run's outcome may depend on, apart from its seed.

    It consists of settings alone, so that an unfinished run is in the group of its finished ones.
    """
    ignored = {"seed", "seeds", "schedule", "checkpoint"}  # the curriculum has the checkpoint, too
    # Proposers that differ only in their seed are samples of one variant, as Solvers are.
    kept = _without_seeds({k: value for k, value in run.config.items() if k not in ignored})
    kept["cycle_length"] = run.config["schedule"].get("cycle_length")
    kept["student"] = run.student
    return kept


def _without_seeds(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns settings with ``*`` in place of seeds in the folders of checkpoints."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            value = _without_seeds(value)
        elif key == "checkpoint" and isinstance(value, str):
            value = _SEED_OF_A_FOLDER.sub("*", value)
        found[key] = value
    return found


def _key(value: Mapping[str, Any]) -> str:
    return json.dumps(value, sort_keys=True)


def _title(run: Run) -> str:
    scale = str(run.config.get("scale", "unnamed"))
    return f"{scale.capitalize()} scale, {run.task.title}"


def _without_doubles(runs: Sequence[Run]) -> tuple[list[Run], list[str]]:
    """Keeps the longest of the runs with equal settings and seed, since a seed counts once."""
    best: dict[str, Run] = {}
    notes = []
    for run in runs:
        key = _key({**_setting(run), **_variant(run), "seed": run.seed})
        kept = best.setdefault(key, run)
        if kept is run:
            continue
        if run.updates > kept.updates:
            best[key], kept, run = run, run, kept
        notes.append(
            f"left out: {run.folder.name}: the same settings and seed as {kept.folder.name}"
        )
    return list(best.values()), notes


def _groups(runs: Sequence[Run]) -> tuple[Group, ...]:
    variants: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        variants[_key(_variant(run))].append(run)
    named: dict[str, list[list[Run]]] = defaultdict(list)
    for members in variants.values():
        named[_plain_label(members[0])].append(sorted(members, key=lambda run: run.seed))
    groups = [
        Group(label, tuple(members), setting)
        for plain, alike in named.items()
        for (label, setting), members in zip(_labels(plain, alike), alike, strict=True)
    ]
    return tuple(sorted(groups, key=lambda group: natural(group.label)))


def _plain_label(run: Run) -> str:
    named = run.method if run.ablation == "none" else f"{run.method}, {run.ablation}"
    return named if run.student is None else f"{named}, student {run.student}"


def _labels(plain: str, alike: Sequence[Sequence[Run]]) -> list[tuple[str, str]]:
    """Returns labels of variants of one name, and the settings in which each differs.

    Settings are as on the command line, or else as in the configurations. Short ones are part of
    the label; otherwise the variants are numbered.
    """
    if len(alike) == 1:
        return [(plain, "")]
    known = (_overrides(members[0]) for members in alike)
    words = [own for own in known if own is not None]
    if len(set(map(frozenset, words))) == len(alike):
        common = frozenset.intersection(*map(frozenset, words))
        settings = [", ".join(word for word in own if word not in common) for own in words]
        texts = [f"{plain}, {setting}" if setting else plain for setting in settings]
    else:
        settings = _differing([dict(_leaves(_variant(members[0]))) for members in alike])
        texts = [f"{plain} ({setting})" for setting in settings]
    order = sorted(range(len(alike)), key=lambda i: natural(settings[i]))
    short = max(map(len, settings)) <= LONGEST_LABEL
    return [
        (texts[i] if short else f"{plain} #{order.index(i) + 1}", setting)
        for i, setting in enumerate(settings)
    ]


def _overrides(run: Run) -> list[str] | None:
    """Returns a run's overrides without its method and those that leave its outcome alone."""
    given = run.facts.get("overrides")
    if given is None:
        return None
    words = [word.lstrip("+") for word in given]
    return [word for word in words if not word.startswith(ASIDE)]


def _differing(leaves: Sequence[Mapping[str, str]]) -> list[str]:
    """Returns the values of each configuration that are not equal in all."""
    keys = sorted({key for leaf in leaves for key in leaf})
    differing = [key for key in keys if len({leaf.get(key) for leaf in leaves}) > 1]
    # Shorten dotted keys to their last part where that is unique.
    last = Counter(key.rpartition(".")[2] for key in differing)
    names = {k: part if last[part := k.rpartition(".")[2]] == 1 else k for k in differing}
    return [
        ", ".join(f"{names[key]}={leaf.get(key, 'absent')}" for key in differing) for leaf in leaves
    ]


def _leaves(value: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{prefix}.{key}" if prefix else key)
    else:
        yield prefix, json.dumps(value)
