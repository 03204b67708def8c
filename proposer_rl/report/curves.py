"""Curves over training: success against updates, frames and seconds, with intervals over seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from proposer_rl.report.outcomes import updates_needed, waiting_outcome, words
from proposer_rl.report.runs import Column, Run
from proposer_rl.report.statistics import mean_interval
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import Drawing, Panel, axes_of, look, style

GRID_POINTS = 200


def learning_curves(study: Study) -> Drawing:
    """The paper's Figure 2: success on every distribution, and updates to the threshold."""
    panels = [_curve_panel(study, f"{name}_success") for name in study.measured]
    rows = len(study.groups)
    bars = Panel(
        "updates",
        f"Updates until {words(study.headline)} reached {study.threshold:.0%}, by method.",
        partial(_draw_bars, study=study),
        (panels[0].size[0], max(1.2 + 0.4 * rows, panels[0].size[1])),
    )
    return Drawing(
        "learning_curves",
        "Success during training, and updates needed (the paper's Figure 2)",
        "Lines: mean over seeds. Bands: 95 % interval of the mean (Student's t). Thin: not all "
        "runs of the method are that long. Bars: mean number of updates, cut at the "
        "horizon, with a bootstrap interval; dots are runs, triangles censored runs, which never "
        "got there.",
        [*panels, bars],
        3,
        [group.label for group in study.groups],
    )


def worst_levels(study: Study) -> Drawing | None:
    """Success on the tenth of the levels where it is lowest; None where that was not measured."""
    names = [f"{name}_success_worst10" for name in study.measured]
    panels = [
        _curve_panel(study, name) for name in names if any(name in r.metrics for r in study.runs)
    ]
    if not panels:
        return None
    return Drawing(
        "worst_levels",
        "Success on the worst tenth of the levels (CVaR)",
        "Mean success over the 10 % of the levels where it is lowest at that moment: a policy that "
        "gives up on hard levels shows here first.",
        panels,
        labels=[group.label for group in study.groups],
    )


def cost_curves(study: Study) -> Drawing:
    """The headline against what was paid for it, the copies' training counted."""
    label = words(study.headline)
    axes: list[tuple[str, str, Callable[[Run], Column]]] = [
        ("frames", "environment frames, millions (copies' counted)", _million_frames),
        ("seconds", "wall-clock minutes (copies' counted)", _minutes),
    ]
    return Drawing(
        "cost",
        "The same success against its whole cost",
        "Frames: the Solver's own plus those of the K copies on which the Proposer learnt. "
        "Minutes: of the whole process, evaluation included; where seeds were trained together, "
        "an even share. Minutes can be compared only between runs on equal machines.",
        [
            Panel(
                name,
                f"{label} against {axis}, by method.",
                partial(
                    _draw_against_cost, groups=study.groups, name=study.headline, axis=axis, x=cost
                ),
            )
            for name, axis, cost in axes
        ],
        labels=[group.label for group in study.groups],
    )


def difficulty(study: Study) -> Drawing | None:
    """What the Solver trained on, for every method."""
    columns = {
        "path_length": "mean shortest path (moves)",
        "obstacle_fraction": "mean share of obstacle cells",
        "train_success": "success rate on the batch",
    }
    groups = [
        group for group in study.groups if all("path_length" in r.training for r in group.runs)
    ]
    if not groups:
        return None
    return Drawing(
        "difficulty",
        "What the Solver trained on",
        "Means over the batch of each evaluated update: its shortest paths, its obstacles, and the "
        "Solver's first episodes on it. Lines and bands as above.",
        [
            Panel(
                name,
                f"{text}, by method.",
                partial(_draw_training, groups=groups, name=name, axis=text),
            )
            for name, text in columns.items()
        ],
        3,
        [group.label for group in groups],
    )


def draw_curve(axes: Axes, x: Column, rows: Column, label: str) -> Column:
    """Mean and interval of runs over x.

    Args:
        axes: where to draw.
        x: float [n].
        rows: float [runs, n], NaN where a run has no value.
        label: of the method.

    Returns:
        The mean, float [n].
    """
    present = (~np.isnan(rows)).sum(0)
    mean = np.array(
        [
            values[~np.isnan(values)].mean() if n else np.nan
            for values, n in zip(rows.T, present, strict=True)
        ]
    )
    whole = present == len(rows)
    axes.plot(x, mean, alpha=0.5, linewidth=0.8, **style(label))
    axes.plot(x, np.where(whole, mean, np.nan), **style(label))
    if len(rows) > 1 and whole.any():
        bounds = np.array([mean_interval(values) for values in rows.T[whole]])
        axes.fill_between(
            x[whole], bounds[:, 1], bounds[:, 2], color=look(label).colour, alpha=0.15, linewidth=0
        )
    return mean


def focus(axes: Axes, means: Sequence[Column], *, zero: bool = False) -> None:
    """Limit the ordinate to the means with some margin: intervals of few runs can be huge.

    Args:
        axes: where they are drawn.
        means: of all methods.
        zero: whether the ordinate begins at zero.
    """
    values = np.concatenate(means) if means else np.empty(0)
    values = values[np.isfinite(values)]
    if len(values):
        low, high = (0.0 if zero else float(values.min())), float(values.max())
        margin = 0.3 * (high - low) or 0.1 * abs(high) or 1.0
        axes.set_ylim(low - (0 if zero else margin), high + margin)


def _curve_panel(study: Study, name: str) -> Panel:
    return Panel(
        name,
        f"{words(name)} against Solver updates, by method.",
        partial(_draw_curves, groups=study.groups, name=name),
    )


def _draw_curves(figure: FigureBase, groups: Sequence[Group], name: str) -> None:
    axes = axes_of(figure)
    for group in groups:
        runs = [run for run in group.runs if name in run.metrics]
        if runs:
            x = np.unique(np.concatenate([run.metrics["updates"] for run in runs]))
            rows = np.array([[run.at(name, updates) for updates in x] for run in runs])
            draw_curve(axes, x, rows, group.label)
    _finish(axes, "Solver updates", f"{words(name).replace('worst10', 'on the worst 10 %')} rate")
    axes.set_ylim(0, 1)


def _draw_training(figure: FigureBase, groups: Sequence[Group], name: str, axis: str) -> None:
    axes = axes_of(figure)
    means = []
    for group in groups:
        x = np.unique(np.concatenate([run.training["updates"] for run in group.runs]))
        rows = np.array([_values_at(run.training, name, x) for run in group.runs])
        means.append(draw_curve(axes, x, rows, group.label))
    _finish(axes, "Solver updates", axis)
    if "success" in name:
        axes.set_ylim(0, 1)
    else:
        focus(axes, means, zero=True)


def _values_at(columns: Mapping[str, Column], name: str, x: Column) -> Column:
    values = dict(zip(columns["updates"], columns[name], strict=True))
    return np.array([values.get(updates, np.nan) for updates in x])


def _draw_against_cost(
    figure: FigureBase,
    groups: Sequence[Group],
    name: str,
    axis: str,
    x: Callable[[Run], Column],
) -> None:
    """Runs stand at different costs when they are measured, so they are interpolated in between."""
    axes = axes_of(figure)
    for group in groups:
        grid = np.linspace(0, max(x(run)[-1] for run in group.runs), GRID_POINTS)
        rows = [
            np.interp(grid, x(run), run.metrics[name], left=np.nan, right=np.nan)
            for run in group.runs
        ]
        draw_curve(axes, grid, np.array(rows), group.label)
    _finish(axes, axis, f"{words(name)} rate")
    axes.set_ylim(0, 1)


def _million_frames(run: Run) -> Column:
    return run.total_frames / 1e6


def _minutes(run: Run) -> Column:
    return (run.own_seconds - run.own_seconds[0]) / 60


def _draw_bars(figure: FigureBase, study: Study) -> None:
    axes = axes_of(figure)
    horizon = study.restricted_to(study.threshold)
    groups = study.compared[::-1]
    for place, group in enumerate(groups):
        waiting = group.waiting(study.headline, study.threshold)
        interval = updates_needed(study, group, study.threshold)
        colour = look(group.label).colour
        axes.barh(place, interval.estimate, 0.62, color=colour, alpha=0.35)
        if not np.isnan(interval.low):
            axes.plot([interval.low, interval.high], [place, place], color=colour, linewidth=2.5)
        offsets = place + np.linspace(-0.2, 0.2, len(waiting)) * (len(waiting) > 1)
        for run, y in zip(waiting, offsets, strict=True):
            marker = "o" if run.reached else ">"
            face = colour if run.reached else "white"
            axes.plot(min(run.updates, horizon), y, marker, ms=4.5, mfc=face, mec=colour, mew=0.9)
        censored = sum(not run.reached for run in waiting)
        axes.annotate(
            f"{censored} of {len(waiting)} censored" if censored else "all reached it",
            (horizon * 1.03, place),
            va="center",
            fontsize=8,
        )
    axes.set_yticks(range(len(groups)), [fill(group.label, 24) for group in groups])
    axes.set_xlim(0, horizon * 1.42)
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= horizon])
    axes.axvline(horizon, color="0.4", linewidth=0.8, linestyle=":")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(waiting_outcome(study, study.threshold).name)


def _finish(axes: Axes, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.margins(x=0.01)
