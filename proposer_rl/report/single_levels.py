"""What is reached on every single level at the end: the worst of them, and two methods compared."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from matplotlib.ticker import FixedLocator, NullLocator, PercentFormatter

from proposer_rl.report.curves import draw_curve
from proposer_rl.report.records import Column, words
from proposer_rl.report.series import Series
from proposer_rl.report.statistics import mean_interval
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import Drawing, Panel, axes_of, finish
from proposer_rl.report.tables import Cell
from proposer_rl.runs.columns import is_rate

SHARES = np.geomspace(0.01, 1.0, 61)
TICKS = (0.01, 0.03, 0.1, 0.3, 1.0)
MOST_PANELS = 8
SIDE = 3.3  # inches of a scatter

SELECTION = {
    True: "The measurements are exact, so that no second evaluation is needed: to sort the levels "
    "by what is averaged selects no luck.",
    False: "The measurements are sampled, and the levels are sorted by what is averaged: selection "
    "bias makes the curves too low, the more the smaller the share.",
    None: "The runs do not say whether their measurements are exact. If they are sampled, "
    "selection bias makes the curves too low, the more the smaller the share.",
}


def worst_means(scores: Column, shares: Column) -> Column:
    """Mean over the worst share of the levels, the conditional value at risk (CVaR).

    A level counts in part where the share is no whole number of levels (Acerbi & Tasche, Journal of
    Banking & Finance 26, 2002, definition 3).

    Args:
        scores: [runs, levels].
        shares: above 0 and at most 1, [n].

    Returns:
        Float [runs, n].
    """
    levels = scores.shape[1]
    sums = np.cumsum(np.sort(scores, 1), 1)  # [runs, levels]
    counts = np.arange(levels + 1)
    whole = [np.interp(shares * levels, counts, [0.0, *row]) for row in sums]
    return np.array(whole) / (shares * levels)


def worst_series(study: Study, group: Group, name: str) -> Series | None:
    """A group's means over the worst levels against their share; None where no run tells."""
    runs, scores = study.tellers(group, name), study.scores(group, name)
    return None if scores is None else Series(SHARES, worst_means(scores, SHARES), runs)


def worst_curves(study: Study) -> Drawing | None:
    """Mean over the worst levels against their share, of each distribution; None without any."""
    names = told(study)
    if not names:
        return None
    levels = study.example.task.levels
    tellers = [g for g in study.groups if any(study.tellers(g, name) for name in names)]
    return Drawing(
        "worst_share",
        f"The worst share of the {levels} at the end (CVaR)",
        f"Mean over the share of the {levels} where a Solver is worst, after {study.horizon} "
        "updates: at 100 % the mean over all. Each seed has worst levels of its own. Lines: mean "
        f"over seeds, with bands as above. {SELECTION[study.example.task.exact]}",
        [
            Panel(
                f"{words(name)} on the worst share of the {levels}, by method.",
                partial(_draw_worst, study=study, name=name),
            )
            for name in names
        ],
        legend={group.label: group.look for group in tellers},
    )


def level_by_level(study: Study) -> Drawing | None:
    """Every method against the baseline on each level; None where there are no two."""
    names = told(study)
    name = study.headline if study.headline in names else next(iter(names), None)
    if name is None or level_means(study, study.baseline, name) is None:
        return None
    known = [
        (float(means.mean()), group)
        for group in study.groups
        if group.label != study.baseline.label
        and (means := level_means(study, group, name)) is not None
    ]
    if not known:
        return None
    best = sorted(known, key=lambda pair: -pair[0])[:MOST_PANELS]
    task, label = study.example.task, study.baseline.label
    more = f" The {MOST_PANELS} best methods; levels.csv has all." * (len(known) > MOST_PANELS)
    return Drawing(
        "level_by_level",
        f"{words(name)} on each of the {task.levels}, against {label}",
        f"Dots: {task.levels}, each the mean over seeds after {study.horizon} updates. Above the "
        f"line the method is better there, below it {label} is.{more}",
        [
            Panel(
                f"{words(name)} of {group.label} against that of {label}, on each level.",
                partial(_draw_scatter, study=study, group=group, name=name),
                (SIDE, SIDE),
            )
            for _, group in best
        ],
        4,
    )


def worst_table(study: Study) -> tuple[list[str], list[list[Cell]]]:
    """The numbers behind the curves over the worst levels."""
    rows: list[list[Cell]] = []
    for name in told(study):
        for group in study.groups:
            found = worst_series(study, group, name)
            if found is not None:
                for share, values in zip(found.x, found.rows.T, strict=True):
                    row = (name, group.label, float(share), len(values), *mean_interval(values))
                    rows.append(list(row))
    return ["measurement", "method", "share", "seeds", "mean", "mean, low", "mean, high"], rows


def level_table(study: Study) -> tuple[list[str], list[list[Cell]]]:
    """Every level's mean over seeds, a column for each method."""
    rows: list[list[Cell]] = []
    for name in told(study):
        means = [level_means(study, group, name) for group in study.groups]
        count = max(len(one) for one in means if one is not None)
        columns = [np.full(count, np.nan) if one is None else one for one in means]
        values = np.transpose(columns)
        rows += [[name, number, *map(float, row)] for number, row in enumerate(values)]
    return ["measurement", "level", *(group.label for group in study.groups)], rows


def told(study: Study) -> list[str]:
    """The measurements that some run tells of every level."""
    groups = study.groups
    return [n for n in study.measurements if any(study.scores(g, n) is not None for g in groups)]


def level_means(study: Study, group: Group, name: str) -> Column | None:
    """What a group reaches on every level, mean over seeds, [levels]; None where no run tells."""
    scores = study.scores(group, name)
    return None if scores is None else scores.mean(0)


def _draw_worst(figure: FigureBase, study: Study, name: str) -> None:
    axes = axes_of(figure)
    found = [(group.look, worst_series(study, group, name)) for group in study.groups]
    means = [draw_curve(axes, one.x, one.rows, look) for look, one in found if one is not None]
    text = f"worst share of the {study.example.task.levels}"
    finish(axes, text, words(name), means, rate=is_rate(name))
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(TICKS))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(PercentFormatter(1, 0))


def _draw_scatter(figure: FigureBase, study: Study, group: Group, name: str) -> None:
    axes: Axes = axes_of(figure)
    x, y = (level_means(study, each, name) for each in (study.baseline, group))
    assert x is not None and y is not None  # or there would be no panel
    ends = (0.0, 1.0) if is_rate(name) else (min(x.min(), y.min()), max(x.max(), y.max()))
    axes.plot(ends, ends, color="0.4", linewidth=0.8)
    # As pixels also in SVG, where thousands of dots would make the page heavy.
    axes.plot(x, y, "o", color=group.look.colour, ms=3.5, alpha=0.35, mew=0, rasterized=True)
    axes.set(xlabel=study.baseline.label, ylabel=group.label, aspect="equal")
    axes.set_title(f"better on {np.mean(y > x):.0%}, worse on {np.mean(y < x):.0%}", fontsize=9)
