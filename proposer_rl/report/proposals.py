"""Figures of what curricula record: gains, proposals, and how their own training goes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from proposer_rl.report.curves import draw_curve
from proposer_rl.report.reading import read_run
from proposer_rl.report.records import GAINS, LONGEST_TEXT, PLACE, Column, Record, number, numbers
from proposer_rl.report.runs import Run, share_map
from proposer_rl.report.series import over_cycles
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import SETTINGS, UPDATES, Drawing, Panel, axes_of, finish

Value = Callable[[Record], float]  # of a cycle; NaN where it has none

STAGES = 5
STRIP = (7.6, 2.1)  # inches, of a row of heat maps
SMALL = (3.6, 2.7)
ANIMATION = (3.6, 3.0)
FRAME_SECONDS = 0.5
MOST_TICKS = 10
MOST_PANELS, MOST_FRAMES = 30, 150
DIAGNOSTICS = {
    "entropy": "entropy (nats)",
    "kl_approx": "KL divergence per epoch (nats)",
    "clip_fraction": "share of clipped ratios",
    "explained_variance": "explained variance of the value",
    "reward_sd": "sd of total reward over the copies",
    "reward_explained": "share of rewards explained by actions",
}
OF_COPIES: Mapping[str, Callable[[Column], float]] = {"maximum": np.max, "mean": np.mean}


def recorded_gain(group: Group) -> str | None:
    """Which gain of the copies a group has on record; None without one."""
    return next((name for name in GAINS if _lists(group, name)), None)


def gains(study: Study) -> Drawing | None:
    """The paper's Figure 4: maximum and mean total gain of a cycle's copies."""
    shown = [(group, name) for group in study.groups if (name := recorded_gain(group))]
    every = {name: np.zeros(1) for _, name in shown}  # of all groups, so that axes are alike
    for group, name in shown:
        every[name] = np.concatenate([every[name], *(c for _, c in _lists(group, name))])
    if not shown:
        return None
    return Drawing(
        "gains",
        f"Total gain in {' or '.join(map(GAINS.__getitem__, every))} of the copies in each cycle "
        "(the paper's Figure 4)",
        "Dots: the total gain on the target of every copy of every seed over one "
        "meta-episode. Lines: maximum and mean over a cycle's copies, averaged over the seeds.",
        [
            Panel(
                f"Total {GAINS[name]} gains of the copies against Solver updates, {group.label}.",
                partial(_draw_gains, group=group, name=name, every=every[name]),
            )
            for group, name in shown
        ],
    )


def heat_maps(study: Study) -> Drawing | None:
    """Where in the space of levels the proposals lie, along training."""
    found = [(group, maps) for group in study.groups if (maps := _histograms(group)) is not None]
    if not found:
        return None
    return Drawing(
        "proposals",
        f"Proposals over {' and '.join(list(found[0][0].runs[0].task.space)[:2])}, along training",
        "Share of a cycle's proposals, averaged over the seeds. White is what even draws would "
        "give, orange is more, purple less: a map that stays "
        "white is a Proposer that has not learnt, or seeds that went different ways.",
        [
            Panel(
                f"Heat maps of the proposals of {group.label} at several stages of training.",
                partial(_draw_strip, group=group, updates=updates, shares=shares),
                STRIP,
                (group.label, partial(_animate, group, updates, shares)),
            )
            for group, (updates, shares) in found
        ],
        1,
    )


def diagnostics(study: Study) -> Drawing | None:
    """How the curricula's own training goes: whatever numbers they recorded."""
    groups = [group for group in study.groups if group.logs]
    values = own_numbers(study)
    if not values:
        return None
    return Drawing(
        "diagnostics",
        "The curricula's own numbers",
        "Per cycle, mean and 95 % interval over seeds; of a list of numbers its mean. Total gain, "
        "mean over standard deviation between the copies: where it is large, all copies gain alike "
        "whatever they are proposed, and there is little to learn from.",
        [
            Panel(
                f"The curricula's {text} against Solver updates.",
                partial(_draw_over_cycles, groups=groups, value=value, axis=text),
                SMALL,
            )
            for text, value in values.items()
        ],
        3,
        {group.label: group.look for group in groups},
    )


def own_numbers(study: Study) -> dict[str, Value]:
    """The numbers of their own that curricula recorded in cycles, by what they are called."""
    groups = [group for group in study.groups if group.logs]
    names = _scalars(groups)
    chosen = {name: text for name, text in DIAGNOSTICS.items() if name in names}
    chosen |= {name: name.replace("_", " ") for name in sorted(names - chosen.keys())}
    values: dict[str, Value] = {
        text: partial(_value, name=name) for name, text in list(chosen.items())[:MOST_PANELS]
    }
    if any(map(recorded_gain, groups)):
        values["total gain: mean / sd of copies"] = partial(_of_gains, names=GAINS, reduce=_ratio)
    return values


def gain_numbers(study: Study) -> dict[str, Value]:
    """Maximum and mean of the gains of a cycle's copies, by what they are called."""
    names = dict.fromkeys(filter(None, map(recorded_gain, study.groups)))
    return {
        f"total gain in {GAINS[name]}, {text} of the copies": partial(
            _of_gains, names=[name], reduce=reduce
        )
        for name in names
        for text, reduce in OF_COPIES.items()
    }


def axis_means(run: Run, cycle: Record) -> list[float] | None:
    """Mean value of a cycle's proposals along each axis; None without a histogram."""
    shares = run.shares(cycle)
    if shares is None:
        return None
    sides = range(shares.ndim)
    return [
        float(shares.sum(tuple(other for other in sides if other != side)) @ values)
        for side, values in zip(sides, run.task.space.values(), strict=True)
    ]


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
        figure, _, _ = _one_map(drawn, run, drawn.max())
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_gains(figure: FigureBase, group: Group, name: str, every: Column) -> None:
    axes = axes_of(figure)
    colour = group.look.colour
    points = np.array([(updates, gain) for updates, c in _lists(group, name) for gain in c])
    # As pixels also in SVG, where thousands of dots would make the page heavy.
    axes.plot(*points.T, ".", color=colour, ms=3, alpha=0.35, rasterized=True)
    for (text, reduce), dash in zip(OF_COPIES.items(), ("-", "--"), strict=True):
        x, rows, _ = over_cycles(group, partial(_of_gains, names=[name], reduce=reduce))
        mean = np.ma.masked_invalid(rows).mean(0)
        axes.plot(x, mean, dash, color=colour, label=f"{text} of the copies")
    axes.axhline(0, color="0.2", linewidth=0.8)
    finish(axes, UPDATES, f"total gain in target {GAINS[name]}", [every])
    axes.set_title(group.label)
    axes.legend(loc="best")


def _draw_strip(figure: FigureBase, group: Group, updates: Column, shares: Column) -> None:
    stages = sorted({round(i) for i in np.linspace(0, len(shares) - 1, STAGES)})
    row = figure.subplots(1, len(stages), squeeze=False, sharey=True)[0]
    _draw_maps(figure, list(row), [shares[i] for i in stages], group.runs[0], shares.max())
    for axes, stage in zip(row, stages, strict=True):
        axes.set_title(f"update {updates[stage]:.0f}", fontsize=9)
    figure.suptitle(group.label, fontsize=10, x=0.01, ha="left")


def _animate(group: Group, updates: Column, shares: Column) -> bytes:
    frames = np.unique(np.linspace(0, len(shares) - 1, min(len(shares), MOST_FRAMES)).round())
    with rc_context(SETTINGS), tempfile.TemporaryDirectory() as folder:
        figure, axes, mesh = _one_map(shares[0], group.runs[0], shares.max())
        title = axes.set_title("")

        def draw(frame: float) -> list[Any]:
            mesh.set_array(shares[int(frame)])
            title.set_text(f"{group.label}, update {updates[int(frame)]:.0f}")
            return [mesh, title]

        file = Path(folder) / "animation.gif"
        writer = PillowWriter(fps=round(1 / FRAME_SECONDS))
        FuncAnimation(figure, draw, frames=list(frames)).save(file, writer=writer, dpi=100)
        return file.read_bytes()


def _one_map(share: Column, run: Run, largest: float) -> tuple[Figure, Axes, Any]:
    figure = Figure(figsize=ANIMATION, layout="constrained")
    axes = axes_of(figure)
    return figure, axes, _draw_maps(figure, [axes], [share], run, largest)


def _draw_maps(
    figure: FigureBase, row: Sequence[Axes], shares: Sequence[Column], run: Run, largest: float
) -> Any:
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
    return mesh


def _ticks(values: Sequence[float]) -> tuple[Column, list[str]]:
    """Places and texts of an axis' values, or of some of them where they are many."""
    step = -(-len(values) // MOST_TICKS)
    return np.arange(0.5, len(values), step), [f"{value:g}" for value in values[::step]]


def _draw_over_cycles(figure: FigureBase, groups: Sequence[Group], value: Value, axis: str) -> None:
    axes = axes_of(figure)
    means = []
    for group in groups:
        x, rows, _ = over_cycles(group, value)
        seen = ~np.isnan(rows).all(0)
        means.append(draw_curve(axes, x[seen], rows[:, seen], group.look))
    finish(axes, UPDATES, axis, means)


def _lists(group: Group, name: str) -> list[tuple[float, Column]]:
    """A list of numbers of every cycle that has it, with the Solver's updates."""
    cycles = [cycle for run in group.logs for cycle in run.cycles]
    found = [(number(cycle["updates"]), numbers(cycle.get(name))) for cycle in cycles]
    return [(updates, values) for updates, values in found if values is not None]


def _value(cycle: Record, name: str) -> float:
    return number(cycle.get(name))


def _of_gains(cycle: Record, names: Iterable[str], reduce: Callable[[Column], float]) -> float:
    """A number of a cycle's gains, of the first that it has; NaN where it has none."""
    found = [values for name in names if (values := numbers(cycle.get(name))) is not None]
    return float(reduce(found[0])) if found else np.nan


def _ratio(gains: Column) -> float:
    spread = float(gains.std(ddof=1)) if len(gains) > 1 else 0.0
    return float(gains.mean()) / spread if spread else np.nan


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


def _scalars(groups: Sequence[Group]) -> set[str]:
    """Names of the numbers that were recorded and are not drawn elsewhere."""
    cycles = [cycle for group in groups for run in group.logs for cycle in run.cycles]
    found = {name for c in cycles for name, value in c.items() if not math.isnan(number(value))}
    return {n for n in found - PLACE - GAINS.keys() if n.isprintable() and len(n) <= LONGEST_TEXT}
