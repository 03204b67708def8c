"""Pictures of levels: along training with the Solver's path, and beside the distributions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from proposer_rl.mazes import Level, LevelDistribution, draw_level
from proposer_rl.report.outcomes import words
from proposer_rl.report.runs import Run, read_run
from proposer_rl.report.studies import Study
from proposer_rl.report.style import SETTINGS, SKY, VERMILLION, Drawing, Panel, axes_of

STAGES = 5
BATCH = 2  # mazes of a batch
SIDE = 1.25  # inches of a maze
SAMPLES = 6
HARDEST = 0.6  # densest obstacles and longest path that are drawn without asking the run
KEY = "Blue: start. Orange: goal. Purple: the Solver's first episode there."


def along_training(study: Study) -> Drawing | None:
    """The paper's Figure 3: mazes of the batch at several stages."""
    shown = [(group.label, group.runs[0]) for group in study.groups if group.runs[0].samples]
    if not shown:
        return None
    return Drawing(
        "levels",
        "Levels along training (the paper's Figure 3)",
        f"The first {BATCH} levels of the batch of the method's first seed. {KEY}",
        [
            Panel(
                label,
                f"Levels that {label} trained on at several stages, with the Solver's path.",
                partial(_draw_stages, samples=run.samples, title=label),
                (SIDE * STAGES, SIDE * BATCH + 0.5),
            )
            for label, run in shown
        ],
    )


def side_by_side(study: Study) -> Drawing | None:
    """The paper's Figure 5: the distributions measured on, early and late proposals."""
    rows = [(name, _sample(study.example, name)) for name in study.measured]
    for group in study.groups:
        if group.proposes and group.runs[0].samples:
            for stage, sample in (
                ("first", group.runs[0].samples[0]),
                ("last", group.runs[0].samples[-1]),
            ):
                levels = [_level(item) for item in sample["levels"]]
                rows.append((f"{group.label}, {stage} (update {sample['updates']})", levels))
    rows = [(title, levels[:SAMPLES]) for title, levels in rows if levels]
    if not rows:
        return None
    return Drawing(
        "samples",
        "Samples: what is measured on, and proposals (the paper's Figure 5)",
        "Random levels of the distributions, and levels that the Proposers made at their first and "
        "last evaluated update. Blue: start. Orange: goal.",
        [
            Panel(
                title,
                f"Sample levels: {title}.",
                partial(_draw_row, levels=levels, title=words(title) if i < 2 else title),
                (SIDE * SAMPLES, SIDE + 0.35),
            )
            for i, (title, levels) in enumerate(rows)
        ],
        1,
    )


def draw_run(folder: Path, title: str) -> Path:
    """One picture of a run: success on every distribution, and levels that were trained on.

    Args:
        folder: a run's folder.
        title: of the picture.

    Returns:
        The file, ``run.png`` in the folder.
    """
    runs = read_run(folder)
    samples = runs[0].samples
    height = (SIDE + 0.15) * BATCH + 0.4
    with rc_context(SETTINGS):
        figure = Figure(figsize=(8.5, 3.2 + height), layout="constrained")
        parts = figure.subfigures(2, 1, squeeze=False, height_ratios=[3.2, height])
        top, bottom = parts[:, 0]
        _draw_success(axes_of(top), runs)
        top.suptitle(title)
        _draw_stages(bottom, samples, KEY)
        file = folder / "run.png"
        figure.savefig(file, dpi=110)
    return file


def _draw_success(axes: Axes, runs: Sequence[Run]) -> None:
    names = [f"{name}_success" for name in runs[0].config["evaluation"]["distributions"]]
    for number, name in enumerate(names):
        colour = (VERMILLION, SKY, "0.3")[number % 3]
        for run in runs:
            label = words(name) if run is runs[0] else None
            axes.plot(run.metrics["updates"], run.metrics[name], color=colour, label=label)
    axes.set(xlabel="Solver updates", ylabel="success rate", ylim=(0, 1))
    axes.margins(x=0)
    axes.legend()


def _draw_stages(figure: FigureBase, samples: Sequence[Mapping[str, Any]], title: str) -> None:
    """Stages from left to right, the levels of a batch from top to bottom."""
    last = len(samples) - 1
    stages = [samples[i] for i in sorted({round(i * last / (STAGES - 1)) for i in range(STAGES)})]
    grid = figure.subplots(BATCH, STAGES, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for column, sample in zip(grid.T, stages, strict=False):
        column[0].set_title(f"update {sample['updates']}", fontsize=8)
        for axes, item in zip(column, sample["levels"], strict=False):
            axes.imshow(draw_level(_level(item), item["path"]).numpy())
    figure.suptitle(title, fontsize=9)


def _draw_row(figure: FigureBase, levels: Sequence[Level], title: str) -> None:
    row = figure.subplots(1, SAMPLES, squeeze=False)[0]
    for axes in row:
        axes.set_axis_off()
    for axes, level in zip(row, levels, strict=False):
        axes.imshow(draw_level(level).numpy())
    figure.suptitle(title, fontsize=9, x=0.01, ha="left")


def _level(item: Mapping[str, Any]) -> Level:
    level: Level = Level.from_text("\n".join(item["level"]))
    return level


def _sample(run: Run, name: str) -> list[Level]:
    """Levels of a distribution of the run's settings, drawn anew; none where that is too hard."""
    settings, maze = run.config["distributions"][name], run.config["maze"]
    cells = maze["height"] * maze["width"]
    pairs = [(float(fraction), int(length)) for fraction, length in settings["specifications"]]
    if any(fraction > HARDEST or length > HARDEST * cells for fraction, length in pairs):
        return []
    try:
        distribution = LevelDistribution(
            pairs, settings["mechanism"], maze["height"], maze["width"]
        )
        levels = distribution.sample(SAMPLES, torch.Generator().manual_seed(0))
    except ValueError:
        return []
    return [levels[i] for i in range(SAMPLES)]
