"""Compares methods over several tasks, on each with the better of the baselines."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from matplotlib.figure import FigureBase

from proposer_rl.report import statistics
from proposer_rl.report.comparisons import TOO_FEW, Decision, difference, primary
from proposer_rl.report.outcomes import Row, cost, factors, signed, threshold_reached
from proposer_rl.report.statistics import ERROR, FEWEST, Estimate
from proposer_rl.report.studies import USUAL_BASELINE, Study
from proposer_rl.report.style import BLUE, VERMILLION, Drawing
from proposer_rl.report.tables import Cell, Table, write
from proposer_rl.runs.folder import is_rate

USUAL_BASELINES = (USUAL_BASELINE, "target")
COLUMNS = 4  # of the figure


@dataclass(frozen=True)
class Arena:
    """The tasks that have all baselines, and the methods on them.

    Attributes:
        tasks: by their names, in the order of these.
        baselines: their labels.
    """

    tasks: Mapping[str, Study]
    baselines: tuple[str, ...]

    @property
    def reference(self) -> str:
        """The baselines that methods are measured against, in words."""
        *others, last = self.baselines
        return f"the better of {', '.join(others)} and {last}" if others else last

    def difference(self, task: str, one: str, other: str) -> Estimate | None:
        """Returns how two methods differ in the mean headline along training; None without both."""
        study = self.tasks[task]
        groups = [study.group(label) for label in (one, other)]
        if groups[0] is None or groups[1] is None:
            return None
        outcome = primary(study)
        found = difference(outcome, groups[0], groups[1])
        few = min(len(group.runs) for group in groups if group) < FEWEST
        # A task without any spread, as where no run ever succeeds, adds no error to a mean.
        return found if few or not math.isnan(found.error) else found._replace(error=0.0)

    @cached_property
    def better(self) -> dict[str, str]:
        """The baseline with the highest mean on each task."""
        return {
            task: max(self.baselines, key=lambda label: _mean(study, label))
            for task, study in self.tasks.items()
        }

    @cached_property
    def found(self) -> dict[str, dict[str, Estimate]]:
        """The difference to the better baseline by method and task, the best worst case first.

        Methods that lack a task come after those that have all.
        """
        labels = {group.label for study in self.tasks.values() for group in study.compared}
        every = {
            label: {
                task: own
                for task in self.tasks
                if (own := self.difference(task, label, self.better[task])) is not None
            }
            for label in sorted(labels)
        }
        order = sorted(every, key=lambda label: (-len(every[label]), -_worst(every[label]).value))
        return {label: every[label] for label in order}

    @cached_property
    def leads(self) -> dict[str, tuple[Estimate, float]]:
        """The first method's mean lead over each other one, with its corrected p-value."""
        first, *others = self.found
        means = [statistics.mean_of_estimates(self._common(first, other)) for other in others]
        corrected = statistics.holm([mean.p for mean in means])
        return dict(zip(others, zip(means, corrected, strict=True), strict=True))

    def _common(self, one: str, other: str) -> list[Estimate]:
        found = (self.difference(task, one, other) for task in self.tasks)
        return [each for each in found if each is not None]

    @cached_property
    def rows(self) -> list[Row]:
        """Every method against the first baseline in the mean over tasks, the best first.

        Methods that lack a task come after those that have all.
        """
        baseline, found = self.baselines[0], self.found
        planned = {label for study in self.tasks.values() for label in study.planned}
        asked = [label for label in found if label != baseline and label in (planned or found)]
        every = {label: self._common(label, baseline) for label in found}
        means = {label: statistics.mean_of_estimates(own) for label, own in every.items() if own}
        asked = [label for label in asked if label in means]
        corrected = dict(zip(asked, statistics.holm([means[a].p for a in asked]), strict=True))
        count = sum(not math.isnan(p) for p in corrected.values())
        rows = []
        for label, mean in means.items():
            p, alone, between = corrected.get(label, math.nan), mean.p, mean.interval()
            tasks, costs = len(every[label]), self._factors(label, baseline)
            name = label if tasks == len(self.tasks) else f"{label} ({tasks} tasks)"
            leader = name if mean.value > 0 else baseline
            decision = Decision(None, TOO_FEW, p, "", None, alone, count, leader)
            own, other = (self._reaching(each, label) for each in (label, baseline))
            where = f"In the mean over {tasks} tasks {label} differs from {baseline} by"
            got = f"reaches the threshold on {own} of them, where {baseline} does on {other}"
            rows.append(
                Row(
                    name,
                    between,
                    None if label == baseline else decision,
                    label in asked,
                    f"{where} {signed(between)} and {got}, at {cost(*costs)}",
                    f"{own} of {tasks}",
                    *costs,
                    f"{write(_worst(found[label]).value)} {_worst_task(found[label])}",
                )
            )
        return sorted(
            rows, key=lambda row: (row.label.endswith(" tasks)"), -row.difference.estimate)
        )

    def _reaching(self, one: str, other: str) -> int:
        """Returns on how many tasks that both have most of one's runs reach the threshold."""
        groups = [(study, study.group(one), study.group(other)) for study in self.tasks.values()]
        return sum(threshold_reached(study, a)[0] for study, a, b in groups if a and b)

    def _factors(self, one: str, other: str) -> tuple[float, float]:
        """Returns geometric means over tasks of the factors of frames and seconds."""
        groups = ([study.group(each) for each in (one, other)] for study in self.tasks.values())
        found = [factors(a, b) for a, b in groups if a and b]
        frames, seconds = np.exp(np.log(found).mean(0)).tolist()
        return frames, seconds


def arena(studies: Sequence[Study], baselines: Sequence[str] = ()) -> Arena | None:
    """Returns the tasks that have all baselines and measure a rate; None if fewer than two do.

    Args:
        studies: each a task.
        baselines: labels; by default those of uniform levels and the target alone, or the one of
            these that was run.
    """
    for chosen in [tuple(baselines)] if baselines else [USUAL_BASELINES, *zip(USUAL_BASELINES)]:
        fit = [
            study
            for study in studies
            if is_rate(study.headline)
            and len(study.compared) > 1
            and all(study.group(label) for label in chosen)
        ]
        if len(fit) > 1:
            return Arena(dict(sorted(zip(_names(fit), fit, strict=True))), chosen)
    return None


def summary(arena: Arena) -> Table:
    """Returns a table of each method's worst case and mean over tasks, and the first one's lead."""
    first, *_ = arena.found
    rows: list[dict[str, Cell]] = []
    every = len(arena.tasks)
    for label, found in arena.found.items():
        lead, p = arena.leads.get(label, (None, None))
        rows.append(
            {
                "method": label,
                "tasks": every if len(found) == every else f"{len(found)} of {every}",
                "worst case": _worst(found).interval(),
                "its task": _worst_task(found),
                "mean over tasks": statistics.mean_of_estimates([*found.values()]).interval(),
                f"{first} minus it, mean over tasks": lead and lead.interval(),
                "p (Holm)": p,
            }
        )
    note = (
        f"Differences are to {arena.reference} in the mean of the headline along training; the "
        "better baseline is chosen on each task by its mean, which makes differences too low "
        "rather than too high. The worst case is the lowest difference over tasks, with its 95 % "
        "interval. In the mean all tasks count alike and are taken as given, so its 95 % interval "
        "is over seeds: the squared errors of the tasks add up, with Satterthwaite's degrees of "
        "freedom. p tests the mean difference between the first method and each other one, on the "
        "tasks that both have and in pairs of runs where seeds agree, by a two-sided t test with "
        "the same errors, corrected for the number of methods (Holm). Intervals are not corrected. "
        "Methods that lack a task come last."
    )
    return Table("arena", f"Worst case and mean over {every} tasks", note, rows)


def about_rows(arena: Arena) -> str:
    """Explains the columns of the first table."""
    count = sum(row.asked for row in arena.rows)
    return (
        "The difference is the method's mean along training minus that of "
        f"{arena.baselines[0]}, averaged over seeds and then over tasks, which count alike, with "
        "an uncorrected 95 % interval; methods are sorted by it. p is corrected for the number of "
        f"comparisons with the baseline, {count} (Holm). The worst task is the one with the lowest "
        f"difference to {arena.reference}. Reached is the number of tasks on which most runs reach "
        "the threshold. × is a multiple of what the baseline spent, including frames of the "
        "curriculum, as a geometric mean over tasks."
    )


def task_table(arena: Arena) -> Table:
    """Returns a table of the differences to the baselines by method and task."""
    rows: list[dict[str, Cell]] = []
    for label, found in arena.found.items():
        for task, to_better in found.items():
            group = arena.tasks[task].group(label)
            row: dict[str, Cell] = {
                "method": label,
                "task": task,
                "seeds": len(group.runs) if group else 0,
                "mean along training": _mean(arena.tasks[task], label),
            }
            for baseline in arena.baselines:
                own = arena.difference(task, label, baseline) if label != baseline else None
                row[f"minus {baseline}"] = own and own.interval()
            if len(arena.baselines) > 1:
                row |= {"minus the better": to_better.interval(), "the better": arena.better[task]}
            rows.append(row)
    note = (
        "Differences of means over seeds with uncorrected 95 % intervals: Student's over pairs of "
        "runs where both have the same seeds, else Welch's; there is none with fewer than "
        f"{FEWEST} seeds."
    )
    return Table("arena_tasks", "Task by task", note, rows)


def answer(arena: Arena) -> list[str]:
    """Summarises how the best method compares to the baseline, and which is best at worst."""
    lead = next((row.sentence for row in arena.rows if row.asked), "")
    first, found = next(iter(arena.found.items()))
    worst = write(_worst(found).interval())
    beaten = [p <= ERROR and lead.value > 0 for lead, p in arena.leads.values()]
    lost = [label for label, (lead, p) in arena.leads.items() if p <= ERROR and lead.value < 0]
    behind = f", and significantly worse than {', '.join(lost)}" if lost else ""
    return [
        *filter(None, [lead]),
        f"Of {len(arena.found)} methods on {len(arena.tasks)} tasks, {first} has the best worst "
        f"case: a difference of {worst} to {arena.reference}, on {_worst_task(found)}.",
        f"In the mean over tasks it is significantly better than {sum(beaten)} of the "
        f"{len(beaten)} others{behind}.",
    ]


def differences(arena: Arena) -> Drawing:
    """Draws each method's difference to the better baseline on every task."""
    count = len(arena.found)
    columns = min(COLUMNS, count)
    rows = -(-count // columns)
    size = (1.6 + 2.2 * columns, 0.7 + (0.75 + 0.19 * len(arena.tasks)) * rows)
    return Drawing(
        "arena",
        f"Difference to {arena.reference}, task by task",
        "Mean of the headline along training, method minus baseline, with its 95 % interval. Blue "
        "is better, red is worse, hollow is neither; the ring is the method's worst case.",
        [partial(_draw, arena=arena, rows=rows, columns=columns)],
        1,
        size=size,
    )


def _draw(figure: FigureBase, arena: Arena, rows: int, columns: int) -> None:
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    places = {task: place for place, task in enumerate(reversed([*arena.tasks]))}
    for axes in grid.flat[len(arena.found) :]:
        axes.set_axis_off()
    for axes, (label, found) in zip(grid.flat, arena.found.items(), strict=False):
        axes.axvline(0, color="0.4", linewidth=0.8)
        for task, estimate in found.items():
            value, low, high = estimate.interval()
            colour = BLUE if low > 0 else VERMILLION if high < 0 else "0.45"
            y, face = places[task], "white" if colour == "0.45" else colour
            axes.plot([low, high], [y, y], color=colour, linewidth=1.6)
            axes.plot(value, y, "o", ms=5, mfc=face, mec=colour, mew=1.1)
        worst = _worst_task(found)
        axes.plot(found[worst].value, places[worst], "o", ms=10, mfc="none", mec="black", mew=0.9)
        axes.set_title(f"{label}\nworst {write(_worst(found).value, 2)}", fontsize=8)
        axes.set_yticks([*places.values()], [*places], fontsize=7)
        axes.set_ylim(-0.8, len(places) - 0.2)
        axes.tick_params(axis="x", labelsize=7)
    for axes in grid.flat[max(len(arena.found) - columns, 0) : len(arena.found)]:
        axes.tick_params(labelbottom=True)  # nothing is below it
        axes.set_xlabel("difference", fontsize=8)


def _mean(study: Study, label: str) -> float:
    group = study.group(label)
    return float(np.mean(primary(study).values(group))) if group else math.nan


def _worst_task(found: Mapping[str, Estimate]) -> str:
    return min(found, key=lambda task: found[task].value)


def _worst(found: Mapping[str, Estimate]) -> Estimate:
    return found[_worst_task(found)]


def _names(studies: Sequence[Study]) -> list[str]:
    """Returns unique names of tasks, from the command lines or else the studies' titles."""
    names, seen = [], Counter[str]()
    for study in studies:
        words = study.example.facts.get("overrides") or []
        called = (word.removeprefix("task=") for word in words if word.startswith("task="))
        name = next(called, study.title)
        seen[name] += 1
        names.append(f"{name} #{seen[name]}" if seen[name] > 1 else name)
    return names
