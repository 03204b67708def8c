"""Figures of what curricula record: gains, proposals, and how their own training goes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from proposer_rl.report.reading import read_run
from proposer_rl.report.records import Column, number
from proposer_rl.report.runs import Run, share_map
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import SETTINGS, Drawing, axes_of

STAGES = 5
STRIP = (7.6, 2.1)  # inches, of a row of heat maps
SINGLE = (3.6, 3.0)
MOST_TICKS = 10


def heat_maps(study: Study) -> Drawing | None:
    """Where in the space of levels the proposals lie, along training."""
    found = [(group, maps) for group in study.groups if (maps := _histograms(group)) is not None]
    if not found:
        return None
    return Drawing(
        "proposals",
        f"Proposals over {' and '.join(list(found[0][0].runs[0].task.space)[:2])}, along training",
        "Share of a cycle's proposals, averaged over the seeds. White is the share "
        "under domain randomization, orange is more, purple less: a map that stays "
        "white is a Proposer that has not learnt, or seeds that went different ways.",
        [
            partial(_draw_strip, group=group, updates=updates, shares=shares)
            for group, (updates, shares) in found
        ],
        1,
        size=STRIP,
    )


def last_map(folder: Path) -> NDArray[np.uint8] | None:
    """The heat map of a running experiment's last cycle as pixels, uint8 [H, W, 3].

    Returns:
        None if its proposals were not recorded.

    Raises:
        UnreadableRun: if the folder is none of a run.
    """
    run = read_run(folder)[0]
    shares = run.shares(run.cycles[-1]) if run.cycles else None
    if shares is None:
        return None
    with rc_context(SETTINGS):
        drawn = share_map(shares)
        figure = Figure(figsize=SINGLE, layout="constrained")
        _draw_maps(figure, [axes_of(figure)], [drawn], run, drawn.max())
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


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
    """Maps side by side with one bar of colours: white is even, orange more, purple less."""
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


def _ticks(values: Sequence[float]) -> tuple[Column, list[str]]:
    """Places and texts of an axis' values, or of some of them where they are many."""
    step = -(-len(values) // MOST_TICKS)
    return np.arange(0.5, len(values), step), [f"{value:g}" for value in values[::step]]


def _histograms(group: Group) -> tuple[Column, Column] | None:
    """Shares of proposals by cycle, [cycles, rows, columns], mean over the runs."""
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
