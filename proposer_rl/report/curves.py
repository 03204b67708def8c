"""Curves over training: what was measured against updates, frames and seconds, over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from proposer_rl.report.comparisons import updates_needed, waiting_outcome
from proposer_rl.report.records import Column, level_text, words
from proposer_rl.report.series import COSTS, Series, band, over_cost, over_updates
from proposer_rl.report.statistics import FEWEST
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import UPDATES, Drawing, Look, Panel, axes_of, finish, style
from proposer_rl.runs.columns import is_rate

MOST_PANELS = 12


def learning_curves(study: Study) -> Drawing:
    """The paper's Figure 2: success on every distribution, and updates to the threshold."""
    panels = [_curve_panel(study, name) for name in study.measurements[:MOST_PANELS]]
    bars = Panel(
        f"Updates until {words(study.headline)} reached "
        f"{level_text(study.headline, study.threshold)}, by method, the soonest first.",
        partial(_draw_bars, study=study),
    )
    return Drawing(
        "learning_curves",
        "The Solver during training, and updates needed (the paper's Figure 2)",
        "Lines: mean over seeds. Bands: 95 % interval of the mean (Student's t), from "
        f"{FEWEST} seeds on; with fewer every seed has a thin line of its own. Thin, too: not all "
        "runs of the method are that long. Bars: mean number of "
        "updates, cut at the horizon, with the same interval; dots are runs, triangles censored "
        "runs, which never got there.",
        [*panels, bars],
        3,
        study.legend,
    )


def worst_levels(study: Study) -> Drawing | None:
    """The tenth of the levels where the Solver is worst; None where that was not measured."""
    names = [f"{name}_worst10" for name in study.measurements[:MOST_PANELS]]
    panels = [
        _curve_panel(study, name) for name in names if any(name in r.metrics for r in study.runs)
    ]
    if not panels:
        return None
    return Drawing(
        "worst_levels",
        f"The worst tenth of the {study.example.task.levels} (CVaR)",
        f"Mean over the 10 % of the {study.example.task.levels} where the Solver is worst at that "
        "moment: a policy that gives up on hard ones shows here first.",
        panels,
        legend=study.legend,
    )


def cost_curves(study: Study) -> Drawing:
    """The headline against updates, and against what was paid for it with the curriculum's part."""
    name = words(study.headline)
    seconds = (
        "Seconds: of the whole process, evaluation included; where seeds were trained together, "
        "an even share. Seconds can be compared only between runs on equal machines."
    )
    if study.timed:
        seconds = (
            "Seconds: updates times what one of the method takes, all methods timed in turns on "
            f"one machine ({study.timed}), without measuring the Solver."
        )
    return Drawing(
        "cost",
        f"The same {name} against updates and against its whole cost",
        "Frames: the Solver's own plus those that the curriculum spent, on copies or on scoring. "
        + seconds,
        [
            _curve_panel(study, study.headline),
            *(
                Panel(
                    f"{name} against {axis}, the curriculum's counted, by method.",
                    partial(_draw_against_cost, study=study, axis=axis),
                )
                for axis in COSTS
            ),
        ],
        3,
        study.legend,
    )


def difficulty(study: Study) -> Drawing | None:
    """What the Solver trained on, by the task's own statistics."""
    names = list(dict.fromkeys(name for run in study.runs for name in run.statistics))
    if not names:
        return None
    told = [group for group in study.groups if any(run.statistics for run in group.runs)]
    return Drawing(
        "difficulty",
        "What the Solver trained on",
        "Statistics of the task over the batch of each evaluated update: means, or where a name "
        "says so standard deviations (sd). Lines and bands as above.",
        [_curve_panel(study, name, "training") for name in names[:MOST_PANELS]],
        3,
        {group.label: group.look for group in told},
    )


def draw_curve(axes: Axes, x: Column, rows: Column, look: Look) -> Column:
    """Mean and interval of runs over x, or all of them where they are too few for an interval.

    Args:
        axes: where to draw.
        x: float [n].
        rows: float [runs, n], NaN where a run has no value.
        look: of the method.

    Returns:
        The mean, float [n].
    """
    mean, whole, low, high = band(rows)
    if len(rows) < FEWEST:
        axes.plot(x, rows.T, alpha=0.5, linewidth=0.6, color=look.colour, linestyle=look.dash)
    axes.plot(x, mean, alpha=0.5, linewidth=0.8, color=look.colour, linestyle=look.dash)
    axes.plot(x, np.where(whole, mean, np.nan), **style(look, len(x)))
    axes.fill_between(x, low, high, color=look.colour, alpha=0.15, linewidth=0)
    return mean


def _curve_panel(study: Study, name: str, table: str = "metrics") -> Panel:
    trained = table == "training"
    text = name.replace("_", " ") if trained else words(name)
    draw = partial(_draw_curves, groups=study.groups, name=name, table=table)
    return Panel(f"{text} against Solver updates, by method.", draw)


def _draw_curves(figure: FigureBase, groups: Sequence[Group], name: str, table: str) -> None:
    trained = table == "training"
    found = [(group, over_updates(group, name, table)) for group in groups]
    text = name.replace("_", " ") if trained else axis_text(name)
    _draw_series(figure, found, UPDATES, text, rate=is_rate(name), zero=trained)


def _draw_against_cost(figure: FigureBase, study: Study, axis: str) -> None:
    name = study.headline
    found = [(group, over_cost(group, name, COSTS[axis])) for group in study.groups]
    _draw_series(figure, found, axis, axis_text(name), rate=is_rate(name))


def _draw_series(
    figure: FigureBase, found: Sequence[tuple[Group, Series | None]], x: str, y: str, **limits: bool
) -> None:
    axes = axes_of(figure)
    drawn = [(group.look, series) for group, series in found if series is not None]
    means = [draw_curve(axes, series.x, series.rows, look) for look, series in drawn]
    finish(axes, x, y, means, **limits)


def axis_text(name: str) -> str:
    """A measurement as an axis is named."""
    rate = " rate" if is_rate(name) else ""
    return f"{words(name).replace('worst10', 'on the worst 10 %')}{rate}"


def _draw_bars(figure: FigureBase, study: Study) -> None:
    axes = axes_of(figure)
    horizon = study.horizon
    needed = [(updates_needed(study, group), group) for group in study.compared]
    found = [(interval, group) for interval, group in needed if interval is not None]
    found.sort(key=lambda each: -each[0].estimate)
    groups = [group for _, group in found]
    for place, (interval, group) in enumerate(found):
        waiting = group.waiting(study.headline, study.threshold)
        colour = group.look.colour
        axes.barh(place, interval.estimate, 0.62, color=colour, alpha=0.35)
        axes.plot(interval[1:], [place] * 2, color=colour, linewidth=2.5)
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
    axes.set_yticks(range(len(groups)), [fill(group.label, 32) for group in groups], fontsize=8)
    axes.set_xlim(0, horizon * 1.42)
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= horizon])
    axes.axvline(horizon, color="0.4", linewidth=0.8, linestyle=":")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(waiting_outcome(study).name)
