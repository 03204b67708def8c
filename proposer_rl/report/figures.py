"""Draws the still figures: curves, bars, levels, and heat maps of proposals."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure, FigureBase

from proposer_rl.report import measures
from proposer_rl.report.comparisons import waiting_outcome
from proposer_rl.report.measures import TRAINED, UPDATES, Measure, Series
from proposer_rl.report.reading import read_run
from proposer_rl.report.runs import Run, share_map
from proposer_rl.report.statistics import FEWEST, HELD, median_interval, median_of
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import (
    SETTINGS,
    SKY,
    VERMILLION,
    Drawing,
    Look,
    finish,
    style,
)
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import Column, LevelRecord, SampleRecord, number, pixels, words

MOST_PANELS = 12
STAGES = 5
BATCH = 2  # levels of a batch
SIDE = 1.25  # inches of a level
STRIP = (7.6, 2.1)  # inches, of a row of heat maps
MOST_TICKS = 10


def learning_curves(study: Study) -> Drawing:
    """Draws measurements along training and updates to the threshold (the paper's Figure 2)."""
    every = measures.measured(study)
    panels = [
        partial(draw_curves, study=study, measure=every[name])
        for name in study.measurements[:MOST_PANELS]
    ]
    return Drawing(
        "learning_curves",
        "The Solver during training, and updates needed (the paper's Figure 2)",
        "Lines are medians over seeds, thin where not all runs of the method are that long. Bands "
        f"are {HELD:.0%} intervals of the median; with fewer than {FEWEST} seeds every seed has a "
        "thin line instead. Bars are median numbers of updates, cut off at the horizon, with the "
        "same interval; dots are runs, and triangles are censored runs, which never got there.",
        [*panels, partial(_draw_bars, study=study)],
        3,
        study.legend,
    )


def draw_series(axes: Axes, series: Series, look: Look) -> np.ndarray:
    """Draws the median of runs with its interval, or every run where they are too few for one.

    Returns:
        The median, float [n].
    """
    series = series.dropna(axis=1, how="all")
    x, whole, (median, low, high) = series.columns, series.notna().all(), median_of(series)
    if len(series) < FEWEST:
        axes.plot(x, series.T, alpha=0.5, linewidth=0.6, color=look.colour, linestyle=look.dash)
    axes.plot(x, median, alpha=0.5, linewidth=0.8, color=look.colour, linestyle=look.dash)
    axes.plot(x, np.where(whole, median, np.nan), **style(look, len(x)))
    axes.fill_between(x, low, high, color=look.colour, alpha=0.15, linewidth=0)
    return median


def draw_curves(figure: FigureBase, study: Study, measure: Measure, axis: str = UPDATES) -> None:
    """Draws a measure of all methods along an axis."""
    axes = figure.subplots()
    found = [(group.look, measure.axes[axis](group)) for group in study.groups]
    means = [draw_series(axes, series, look) for look, series in found if series is not None]
    finish(axes, axis, measure.name, means, rate=measure.rate, zero=measure.kind == TRAINED)


def _draw_bars(figure: FigureBase, study: Study) -> None:
    axes = figure.subplots()
    horizon, outcome = study.horizon, waiting_outcome(study)
    # Every run that is compared has a value, at most the horizon.
    found = [(median_interval(outcome.values(group)), group) for group in study.compared]
    found.sort(key=lambda each: -each[0].estimate)
    for place, (interval, group) in enumerate(found):
        waiting = [run.reached(study.headline, study.threshold) for run in group.runs]
        colour = group.look.colour
        axes.barh(place, interval.estimate, 0.62, color=colour, alpha=0.35)
        axes.plot(interval[1:], [place] * 2, color=colour, linewidth=2.5)
        offsets = place + np.linspace(-0.2, 0.2, len(waiting)) * (len(waiting) > 1)
        for reached, y in zip(waiting, offsets, strict=True):
            marker, face = (">", "white") if np.isnan(reached) else ("o", colour)
            axes.plot(np.fmin(reached, horizon), y, marker, ms=4.5, mfc=face, mec=colour, mew=0.9)
        censored = int(np.isnan(waiting).sum())
        axes.annotate(
            f"{censored} of {len(waiting)} censored" if censored else "all reached it",
            (horizon * 1.03, place),
            va="center",
            fontsize=8,
        )
    axes.set_yticks(range(len(found)), [fill(group.label, 32) for _, group in found], fontsize=8)
    axes.set_xlim(0, max(horizon, 1) * 1.42)  # the horizon of a run that has just begun is 0
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= horizon])
    axes.axvline(horizon, color="0.4", linewidth=0.8, linestyle=":")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(outcome.name)


def draw_run(folder: Path, title: str) -> Path:
    """Draws the measurements and training levels of a run to ``run.png``, and returns its path."""
    runs = read_run(folder)
    height = (SIDE + 0.15) * BATCH + 0.4
    with rc_context(SETTINGS):
        figure = Figure(figsize=(8.5, 3.2 + height), layout="constrained")
        parts = figure.subfigures(2, 1, squeeze=False, height_ratios=[3.2, height])
        top, bottom = parts[:, 0]
        _draw_measurements(top.subplots(), runs)
        top.suptitle(title)
        if runs[0].samples:
            _draw_stages(bottom, runs[0].samples, runs[0].task.key)
        file = folder / "run.png"
        figure.savefig(file, dpi=110)
    return file


def _draw_measurements(axes: Axes, runs: Sequence[Run]) -> None:
    names = runs[0].measurements
    for place, name in enumerate(names):
        colour = (VERMILLION, SKY, "0.3")[place % 3]
        for run in runs:
            label = words(name) if run is runs[0] else None
            axes.plot(run.metrics["updates"], run.metrics[name], color=colour, label=label)
    rates, every = all(map(is_rate, names)), [run.metrics[name] for run in runs for name in names]
    finish(axes, UPDATES, "rate" if rates else "measurement", every, rate=rates)
    axes.legend()


def _draw_stages(figure: FigureBase, samples: Sequence[SampleRecord], title: str) -> None:
    """Draws stages from left to right, and levels of a batch from top to bottom."""
    last = len(samples) - 1
    stages = [samples[i] for i in sorted({round(i * last / (STAGES - 1)) for i in range(STAGES)})]
    grid = figure.subplots(BATCH, STAGES, squeeze=False)
    for column, sample in zip(grid.T, stages, strict=False):
        column[0].set_title(f"update {sample.updates}", fontsize=8)
        _show(column, sample.levels)
    _show(list(grid.T[len(stages) :].flat), ())
    figure.suptitle(title, fontsize=9)


def _show(places: Sequence[Axes], levels: Sequence[LevelRecord]) -> None:
    """Draws pictures of levels; a place stays empty where there is none."""
    for axes in places:
        axes.set_axis_off()
    for axes, level in zip(places, levels, strict=False):
        if level.picture is not None:
            axes.imshow(pixels(level.picture))


def heat_maps(study: Study) -> Drawing | None:
    """Draws the distribution of proposals in the space of levels along training, if recorded."""
    found = [(group, maps) for group in study.groups if (maps := _histograms(group)) is not None]
    if not found:
        return None
    return Drawing(
        "proposals",
        f"Proposals over {' and '.join(list(found[0][0].runs[0].task.space)[:2])}, along training",
        "Shares of a cycle's proposals, averaged over the seeds. White is the share under domain "
        "randomization; orange is more, purple is less. A map that stays white shows a curriculum "
        "that has not learnt, or seeds that went different ways.",
        [
            partial(_draw_strip, group=group, updates=updates, shares=shares)
            for group, (updates, shares) in found
        ],
        1,
        size=STRIP,
    )


def _draw_strip(figure: FigureBase, group: Group, updates: Column, shares: Column) -> None:
    stages = sorted({round(i) for i in np.linspace(0, len(shares) - 1, STAGES)})
    row = figure.subplots(1, len(stages), squeeze=False, sharey=True)[0]
    _draw_maps(figure, list(row), [shares[i] for i in stages], group.runs[0], shares.max())
    for axes, stage in zip(row, stages, strict=True):
        axes.set_title(f"update {updates[stage]:.0f}", fontsize=9)
    figure.suptitle(group.label, fontsize=10, x=0.01, ha="left")


def _draw_maps(
    figure: FigureBase, row: Sequence[Axes], shares: Sequence[Column], run: Run, largest: float
) -> None:
    """Draws maps side by side with one colour bar: white is even, orange more, purple less."""
    even = 1 / shares[0].size
    largest = max(largest, 2 * even)
    *above, (across, columns) = list(run.task.space.items())[:2]
    for axes, share in zip(row, shares, strict=True):
        mesh = axes.pcolormesh(share, cmap="PuOr_r", norm=TwoSlopeNorm(even, 0, largest))
        axes.set_xticks(*_ticks(columns))
        axes.set_xlabel(across, fontsize=8)
        axes.set_yticks([])
        for name, values in above:
            axes.set_yticks(*_ticks(values))
            axes.set_ylabel(name if axes is row[0] else "", fontsize=8)
        axes.tick_params(labelsize=7, length=0)
        axes.grid(visible=False)
    bar = figure.colorbar(mesh, ax=list(row), format=lambda value, _: f"{value:.1%}")
    bar.set_ticks([0, even, largest])
    bar.set_label("share of proposals", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _ticks(values: Sequence[float | str]) -> tuple[Column, list[str]]:
    """Returns places and texts for an axis's values, or for some where they are many."""
    step = -(-len(values) // MOST_TICKS)
    texts = [value if isinstance(value, str) else f"{value:g}" for value in values[::step]]
    return np.arange(0.5, len(values), step), texts


def _histograms(group: Group) -> tuple[Column, Column] | None:
    """Returns updates [cycles] and shares of proposals [cycles, rows, columns], means over runs."""
    by_updates: dict[float, list[Column]] = {}
    for run in group.logs:
        for cycle in run.cycles:
            shares = group.runs[0].shares(cycle)
            if shares is not None:
                by_updates.setdefault(number(cycle["updates"]), []).append(share_map(shares))
    if not by_updates:
        return None
    updates = sorted(by_updates)
    return np.array(updates), np.array([np.mean(by_updates[u], 0) for u in updates])
