"""Figures of curves over training, and of single levels at its end."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from matplotlib.ticker import FixedLocator, NullLocator, PercentFormatter

from proposer_rl.report import measures
from proposer_rl.report.comparisons import waiting_outcome
from proposer_rl.report.measures import TRAINED, Measure, Series
from proposer_rl.report.records import words
from proposer_rl.report.statistics import FEWEST, HELD, median_of
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import PANEL, Drawing, Look, axes_of, finish, style
from proposer_rl.runs.columns import is_rate

MOST_PANELS = 12
MOST_SCATTERS = 8
TICKS = (0.01, 0.03, 0.1, 0.3, 1.0)
SIDE = 3.3  # inches of a scatter
SMALL = (3.6, 2.7)
SELECTION = {
    True: "The measurements are exact, so that no second evaluation is needed: to sort the levels "
    "by what is averaged selects no luck.",
    False: "The measurements are sampled, and the levels are sorted by what is averaged: selection "
    "bias makes the curves too low, the more the smaller the share.",
    None: "The runs do not say whether their measurements are exact. If they are sampled, "
    "selection bias makes the curves too low, the more the smaller the share.",
}


def learning_curves(study: Study) -> Drawing:
    """The paper's Figure 2: success on every distribution, and updates to the threshold."""
    every = measures.measured(study)
    panels = [_panel(study, every[name]) for name in study.measurements[:MOST_PANELS]]
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
        [_panel(study, measure, axis) for axis in measure.axes],
        3,
        study.legend,
    )


def level_by_level(study: Study) -> Drawing | None:
    """Every method against the baseline on each level; None where there are no two."""
    names = measures.of_levels(study)
    name = study.headline if study.headline in names else next(iter(names), None)
    if name is None or measures.level_means(study, study.baseline, name) is None:
        return None
    known = [
        (float(means.mean()), group)
        for group in study.groups
        if group.label != study.baseline.label
        and (means := measures.level_means(study, group, name)) is not None
    ]
    if not known:
        return None
    best = sorted(known, key=lambda pair: -pair[0])[:MOST_SCATTERS]
    task, label = study.example.task, study.baseline.label
    more = f" The {MOST_SCATTERS} best methods; levels.csv has all." * (len(known) > MOST_SCATTERS)
    return Drawing(
        "level_by_level",
        f"{words(name)} on each of the {task.levels}, against {label}",
        f"Dots: {task.levels}, each the mean over seeds after {study.horizon} updates. Above the "
        f"line the method is better there, below it {label} is.{more}",
        [partial(_draw_scatter, study=study, group=group, name=name) for _, group in best],
        4,
        size=(SIDE, SIDE),
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


def _panel(study: Study, measure: Measure, axis: str = "") -> Callable[[FigureBase], None]:
    axis = axis or next(iter(measure.axes))
    return partial(_draw_curves, study=study, measure=measure, axis=axis)


def _draw_curves(figure: FigureBase, study: Study, measure: Measure, axis: str) -> None:
    axes = axes_of(figure)
    found = [(group.look, measure.axes[axis](group)) for group in study.groups]
    means = [draw_series(axes, series, look) for look, series in found if series is not None]
    finish(axes, axis, measure.name, means, rate=measure.rate, zero=measure.kind == TRAINED)
    if measure.log:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator(TICKS))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(PercentFormatter(1, 0))


def _draw_scatter(figure: FigureBase, study: Study, group: Group, name: str) -> None:
    axes: Axes = axes_of(figure)
    x, y = (measures.level_means(study, each, name) for each in (study.baseline, group))
    assert x is not None and y is not None  # or there would be no panel
    ends = (0.0, 1.0) if is_rate(name) else (min(x.min(), y.min()), max(x.max(), y.max()))
    axes.plot(ends, ends, color="0.4", linewidth=0.8)
    # As pixels also in SVG, where thousands of dots would make the page heavy.
    axes.plot(x, y, "o", color=group.look.colour, ms=3.5, alpha=0.35, mew=0, rasterized=True)
    axes.set(xlabel=study.baseline.label, ylabel=group.label, aspect="equal")
    axes.set_title(f"better on {np.mean(y > x):.0%}, worse on {np.mean(y < x):.0%}", fontsize=9)


def _draw_bars(figure: FigureBase, study: Study) -> None:
    axes = axes_of(figure)
    horizon, outcome = study.horizon, waiting_outcome(study)
    needed = [(outcome.median(group), group) for group in study.compared]
    found = [(interval, group) for interval, group in needed if interval is not None]
    found.sort(key=lambda each: -each[0].estimate)
    groups = [group for _, group in found]
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
    axes.set_yticks(range(len(groups)), [fill(group.label, 32) for group in groups], fontsize=8)
    axes.set_xlim(0, horizon * 1.42)
    axes.set_xticks([tick for tick in axes.get_xticks() if tick <= horizon])
    axes.axvline(horizon, color="0.4", linewidth=0.8, linestyle=":")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(outcome.name)


def _of_measures(
    name: str,
    title: str,
    caption: str,
    drawn: Callable[[Study], Iterable[Measure]],
    columns: int = 3,
    size: tuple[float, float] = PANEL,
) -> Callable[[Study], Drawing | None]:
    """A figure with a panel for each measure that a method has; None without any.

    Title and caption may name what ``levels`` are called, the ``horizon``, and what ``selection``
    does to the worst of them.
    """

    def draw(study: Study) -> Drawing | None:
        panels, shown = [], set()
        for measure in drawn(study):
            series = next(iter(measure.axes.values()))
            having = {group.label for group in study.groups if series(group) is not None}
            if having:
                panels.append(_panel(study, measure))
                shown |= having
        if not panels:
            return None
        task = study.example.task
        selection = SELECTION[task.exact]
        terms = {"levels": task.levels, "horizon": study.horizon, "selection": selection}
        legend = {label: look for label, look in study.legend.items() if label in shown}
        head, text = title.format_map(terms), caption.format_map(terms)
        return Drawing(name, head, text, panels, columns, legend, size)

    return draw


worst_levels = _of_measures(
    "worst_levels",
    "The worst tenth of the {levels} (CVaR)",
    "Mean over the 10 % of the {levels} where the Solver is worst at that moment: a policy that "
    "gives up on hard ones shows here first.",
    measures.worst_tenths,
    2,
)
worst_curves = _of_measures(
    "worst_share",
    "The worst share of the {levels} at the end (CVaR)",
    "Mean over the share of the {levels} where a Solver is worst, after {horizon} updates: at "
    "100 % the mean over all. Each seed has worst levels of its own. Lines: median over seeds, "
    "with bands as above. {selection}",
    measures.worst,
    2,
)
difficulty = _of_measures(
    "difficulty",
    "What the Solver trained on",
    "Statistics of the task over the batch of each evaluated update: means, or where a name says "
    "so standard deviations (sd). Lines and bands as above.",
    measures.trained,
)
gains_of_replicas = _of_measures(
    "gains",
    "Total gain of the replicas in each cycle (the paper's Figure 4)",
    "The total gain on the target of the replicas over one meta-episode: maximum and mean over a "
    "cycle's replicas. Lines and bands as above.",
    measures.gains,
    2,
)
diagnostics = _of_measures(
    "diagnostics",
    "The curricula's own numbers",
    "Per cycle, median and interval over seeds; of a list of numbers its mean. Total gain, mean "
    "over standard deviation between the replicas: where it is large, all replicas gain alike "
    "whatever they are proposed, and there is little to learn from.",
    measures.own_numbers,
    size=SMALL,
)
