"""Figures of curves over training, and of single levels at its end."""

from __future__ import annotations

from functools import partial
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from proposer_rl.report import measures
from proposer_rl.report.comparisons import waiting_outcome
from proposer_rl.report.measures import TRAINED, UPDATES, Measure, Series
from proposer_rl.report.statistics import FEWEST, HELD, median_interval, median_of
from proposer_rl.report.studies import Study
from proposer_rl.report.style import Drawing, Look, finish, style
from proposer_rl.runs.records import words

MOST_PANELS = 12


def learning_curves(study: Study) -> Drawing:
    """The paper's Figure 2: success on every distribution, and updates to the threshold."""
    every = measures.measured(study)
    panels = [
        partial(_draw_curves, study=study, measure=every[name])
        for name in study.measurements[:MOST_PANELS]
    ]
    return Drawing(
        "learning_curves",
        "The Solver during training, and updates needed (the paper's Figure 2)",
        f"Lines: median over seeds. Bands: {HELD:.0%} interval of the median, from {FEWEST} "
        "seeds on; with fewer every seed has a thin line of its own. Thin, too: not all "
        "runs of the method are that long. Bars: median number of "
        "updates, cut at the horizon, with the same interval; dots are runs, triangles censored "
        "runs, which never got there.",
        [*panels, partial(_draw_bars, study=study)],
        3,
        study.legend,
    )


def cost_curves(study: Study) -> Drawing:
    """The headline against updates and every cost, the curriculum's part included."""
    measure = measures.measured(study)[study.headline]
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
        f"The same {words(study.headline)} against updates and against its whole cost",
        "Frames: the Solver's own plus those that the curriculum spent, on replicas or on scoring. "
        + seconds,
        [partial(_draw_curves, study=study, measure=measure, axis=axis) for axis in measure.axes],
        3,
        study.legend,
    )


def difficulty(study: Study) -> Drawing | None:
    """What the Solver trained on; None where no run has statistics of it."""
    every = measures.trained(study)
    shown = [g for g in study.groups if any(each.axes[UPDATES](g) is not None for each in every)]
    if not shown:
        return None
    return Drawing(
        "difficulty",
        "What the Solver trained on",
        "Statistics of the task over the batch of each evaluated update: means, or where a name "
        "says so standard deviations (sd). Lines and bands as above.",
        [partial(_draw_curves, study=study, measure=measure) for measure in every],
        3,
        {group.label: group.look for group in shown},
    )


def draw_series(axes: Axes, series: Series, look: Look) -> np.ndarray:
    """Median and interval of runs, or all of them where they are too few for an interval.

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


def _draw_curves(figure: FigureBase, study: Study, measure: Measure, axis: str = UPDATES) -> None:
    axes = figure.subplots()
    found = [(group.look, measure.axes[axis](group)) for group in study.groups]
    means = [draw_series(axes, series, look) for look, series in found if series is not None]
    finish(axes, axis, measure.name, means, rate=measure.rate, zero=measure.kind == TRAINED)


def _draw_bars(figure: FigureBase, study: Study) -> None:
    axes = figure.subplots()
    horizon, outcome = study.horizon, waiting_outcome(study)
    # Every run that is compared has waited, if only until the horizon.
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
    axes.set_xlim(0, horizon * 1.42)
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= horizon])
    axes.axvline(horizon, color="0.4", linewidth=0.8, linestyle=":")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(outcome.name)
