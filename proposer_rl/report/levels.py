"""Pictures of levels: along training with the Solver, and beside what is measured on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from proposer_rl.report.measures import UPDATES
from proposer_rl.report.reading import read_run
from proposer_rl.report.records import LevelRecord, SampleRecord, picture, words
from proposer_rl.report.runs import Run
from proposer_rl.report.studies import Study
from proposer_rl.report.style import (
    SETTINGS,
    SKY,
    VERMILLION,
    Drawing,
    axes_of,
    finish,
)
from proposer_rl.runs.columns import is_rate

STAGES = 5
BATCH = 2  # levels of a batch
SIDE = 1.25  # inches of a level
SAMPLES = 6


def along_training(study: Study) -> Drawing | None:
    """The paper's Figure 3: levels of the batch at several stages."""
    shown = [(group.label, group.runs[0].samples) for group in study.groups]
    panels = [
        partial(_draw_stages, samples=samples, title=label)
        for label, samples in shown
        if any(level.picture for sample in samples for level in sample.levels[:BATCH])
    ]
    if not panels:
        return None
    task = study.example.task
    return Drawing(
        "levels",
        f"{task.levels.capitalize()} along training (the paper's Figure 3)",
        f"The first {BATCH} {task.levels} of the batch of the method's first seed. {task.key}",
        panels,
        size=(SIDE * STAGES, SIDE * BATCH + 0.5),
    )


def side_by_side(study: Study) -> Drawing | None:
    """The paper's Figure 5: the distributions measured on, early and late proposals."""
    task = study.example.task
    rows = [(words(name), task.samples.get(name, [])) for name in task.distributions]
    for group in study.groups:
        samples = group.runs[0].samples if group.proposes else ()
        for stage, sample in zip(("first", "last"), (*samples[:1], *samples[-1:]), strict=False):
            rows.append((f"{group.label}, {stage} (update {sample.updates})", sample.levels))
    return _in_rows(
        rows,
        "samples",
        "Samples: what is measured on, and proposals (the paper's Figure 5)",
        f"Random {task.levels} of the distributions, and those that the Proposers made at their "
        f"first and last evaluated update. {task.key}",
    )


def recorded_by_curricula(study: Study) -> Drawing | None:
    """Levels that curricula recorded: the last time, of each method's first seed."""
    task = study.example.task
    rows = [
        (f"{group.label}: {caption}", levels)
        for group in study.groups
        for caption, levels in group.runs[0].sheets.items()
    ]
    return _in_rows(
        rows,
        "recorded",
        f"{task.levels.capitalize()} that the curricula recorded",
        "As each curriculum recorded them last, in its first seed: what is in its buffer, say. "
        f"{task.key}",
    )


def _in_rows(
    rows: Sequence[tuple[str, Sequence[LevelRecord]]], name: str, title: str, caption: str
) -> Drawing | None:
    """A row of pictures for each title that has any; None without one."""
    panels = [
        partial(_draw_row, levels=levels, title=head)
        for head, levels in rows
        if any(level.picture for level in levels[:SAMPLES])
    ]
    size = (SIDE * SAMPLES, SIDE + 0.35)
    return Drawing(name, title, caption, panels, 1, size=size) if panels else None


def draw_run(folder: Path, title: str) -> Path:
    """One picture of a run: what was measured on every distribution, and levels trained on.

    Args:
        folder: a run's folder.
        title: of the picture.

    Returns:
        The file, ``run.png`` in the folder.
    """
    runs = read_run(folder)
    height = (SIDE + 0.15) * BATCH + 0.4
    with rc_context(SETTINGS):
        figure = Figure(figsize=(8.5, 3.2 + height), layout="constrained")
        parts = figure.subfigures(2, 1, squeeze=False, height_ratios=[3.2, height])
        top, bottom = parts[:, 0]
        _draw_measurements(axes_of(top), runs)
        top.suptitle(title)
        if runs[0].samples:
            _draw_stages(bottom, runs[0].samples, runs[0].task.key)
        file = folder / "run.png"
        figure.savefig(file, dpi=110)
    return file


def _draw_measurements(axes: Axes, runs: Sequence[Run]) -> None:
    names = runs[0].measurements
    for number, name in enumerate(names):
        colour = (VERMILLION, SKY, "0.3")[number % 3]
        for run in runs:
            label = words(name) if run is runs[0] else None
            axes.plot(run.metrics["updates"], run.metrics[name], color=colour, label=label)
    rates, every = all(map(is_rate, names)), [run.metrics[name] for run in runs for name in names]
    finish(axes, UPDATES, "rate" if rates else "measurement", every, rate=rates)
    axes.legend()


def _draw_stages(figure: FigureBase, samples: Sequence[SampleRecord], title: str) -> None:
    """Stages from left to right, the levels of a batch from top to bottom."""
    last = len(samples) - 1
    stages = [samples[i] for i in sorted({round(i * last / (STAGES - 1)) for i in range(STAGES)})]
    grid = figure.subplots(BATCH, STAGES, squeeze=False)
    for column, sample in zip(grid.T, stages, strict=False):
        column[0].set_title(f"update {sample.updates}", fontsize=8)
        _show(column, sample.levels)
    _show(list(grid.T[len(stages) :].flat), ())
    figure.suptitle(title, fontsize=9)


def _draw_row(figure: FigureBase, levels: Sequence[LevelRecord], title: str) -> None:
    _show(figure.subplots(1, SAMPLES, squeeze=False)[0], levels)
    figure.suptitle(title, fontsize=9, x=0.01, ha="left")


def _show(places: Sequence[Axes], levels: Sequence[LevelRecord]) -> None:
    """Draw pictures of levels; a place stays empty where there is none that can be shown."""
    for axes in places:
        axes.set_axis_off()
    for axes, level in zip(places, levels, strict=False):
        image = picture(level.picture)
        if image is not None:
            axes.imshow(image)
