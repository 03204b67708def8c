"""Figures of Proposers: their gains, what they propose, and how their training goes."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
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

from proposer_rl.report.curves import draw_curve, focus
from proposer_rl.report.runs import Column, Run, read_run
from proposer_rl.report.studies import Group, Study
from proposer_rl.report.style import (
    SETTINGS,
    Drawing,
    Panel,
    axes_of,
    look,
)

STAGES = 5
STRIP = (7.6, 2.1)  # inches, of a row of heat maps
ANIMATION = (3.6, 3.0)
FRAME_SECONDS = 0.5
DIAGNOSTICS = {
    "entropy": "entropy (nats)",
    "kl_approx": "KL divergence per epoch (nats)",
    "clip_fraction": "share of clipped ratios",
    "explained_variance": "explained variance of the value",
    "gain_sd": "sd of total gain over the copies",
    "gain_explained": "share of gains explained by actions",
}
PLACE = {"cycle", "updates", "meta_frames", "seed"}


def proposers(study: Study) -> list[Group]:
    """Groups with a Proposer."""
    return [group for group in study.groups if group.proposes]


def gains(study: Study) -> Drawing | None:
    """The paper's Figure 4: maximum and mean total gain of a cycle's copies."""
    groups = proposers(study)
    if not groups:
        return None
    limits = {
        measure: _limits([group for group in groups if _measure(group) == measure])
        for measure in {_measure(group) for group in groups}
    }
    return Drawing(
        "gains",
        "Total gain of the copies in each cycle (the paper's Figure 4)",
        "Dots: the total gain on the target of every copy of every seed over one "
        "meta-episode. Lines: maximum and mean over a cycle's copies, averaged over the seeds.",
        [
            Panel(
                group.label,
                f"Total gains of the copies against Solver updates, {group.label}.",
                partial(_draw_gains, group=group, limits=limits[_measure(group)]),
            )
            for group in groups
        ],
    )


def heat_maps(study: Study) -> Drawing | None:
    """Where in the space of levels the proposals lie, along training."""
    groups = [group for group in proposers(study) if _histograms(group) is not None]
    if not groups:
        return None
    return Drawing(
        "proposals",
        "Proposals over obstacle fraction and path length, along training",
        "Share of a cycle's proposals, averaged over the seeds. White is what even draws would "
        "give, orange is more, purple less: a map that stays "
        "white is a Proposer that has not learnt, or seeds that went different ways.",
        [
            Panel(
                group.label,
                f"Heat maps of the proposals of {group.label} at several stages of training.",
                partial(_draw_strip, group=group),
                STRIP,
            )
            for group in groups
        ],
        1,
    )


def animate(group: Group) -> bytes | None:
    """The heat map of every cycle as an animated GIF; None without histograms."""
    found = _histograms(group)
    if found is None:
        return None
    updates, shares = found
    with rc_context(SETTINGS):
        figure = Figure(figsize=ANIMATION, layout="constrained")
        axes = axes_of(figure)
        mesh = _draw_map(axes, shares[0], group.runs[0], shares.max(), edge=True)
        _colour_bar(figure, mesh, axes, shares[0].size, shares.max())
        title = axes.set_title("")

        def draw(frame: int) -> list[Any]:
            mesh.set_array(shares[frame])
            title.set_text(f"{group.label}, update {updates[frame]:.0f}")
            return [mesh, title]

        return _gif(FuncAnimation(figure, draw, frames=len(shares)))


def diagnostics(study: Study) -> Drawing | None:
    """How the Proposers' own training goes: PPO's numbers and whatever else was recorded."""
    groups = proposers(study)
    names = {name for g in groups for r in g.runs for c in r.cycles for name in _scalars(c)}
    chosen = {name: text for name, text in DIAGNOSTICS.items() if name in names}
    further = sorted(name for name in names if "signal" in name or "noise" in name)
    chosen |= {name: name.replace("_", " ") for name in further}
    panels = [
        Panel(
            name,
            f"The Proposers' {text} against Solver updates.",
            partial(_draw_scalar, groups=groups, name=name, axis=text),
            (3.6, 2.7),
        )
        for name, text in chosen.items()
    ]
    if not panels:
        return None
    ratio = Panel(
        "gain_ratio",
        "Mean total gain over its standard deviation across copies, against Solver updates.",
        partial(_draw_ratio, groups=groups),
        (3.6, 2.7),
    )
    return Drawing(
        "diagnostics",
        "The Proposers' training",
        "Per cycle, mean and 95 % interval over seeds. The last panel is the spread that the "
        "Proposer can learn from: mean total gain over its standard deviation between the copies; "
        "where it is large, all copies gain alike whatever they are proposed.",
        [*panels, ratio],
        3,
        [group.label for group in groups],
    )


def histogram_means(run: Run, cycle: Mapping[str, Any]) -> tuple[float, float] | None:
    """Mean path length and obstacle fraction of a cycle's proposals; None without a histogram."""
    share = proposal_shares(run, cycle)
    if share is None:
        return None
    fractions, lengths = _space(run)
    return float(share.sum(0) @ lengths), float(share.sum(1) @ fractions)


def last_map(folder: Path) -> NDArray[np.uint8] | None:
    """The heat map of a running experiment's last cycle as pixels, uint8 [H, W, 3].

    Returns:
        None if its proposals were not recorded.

    Raises:
        UnreadableRun: if the folder is none of a run.
    """
    run = read_run(folder)[0]
    share = proposal_shares(run, run.cycles[-1]) if run.cycles else None
    if share is None:
        return None
    with rc_context(SETTINGS):
        figure = Figure(figsize=ANIMATION, layout="constrained")
        axes = axes_of(figure)
        mesh = _draw_map(axes, share, run, share.max(), edge=True)
        _colour_bar(figure, mesh, axes, share.size, share.max())
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _measure(group: Group) -> str:
    """What the gains are counted in."""
    return str(group.runs[0].config["proposer"].get("measure", "return")).replace("_", " ")


def _limits(groups: Sequence[Group]) -> tuple[float, float]:
    """Of an axis that shows all gains of these groups, and zero."""
    every = [gain for g in groups for r in g.runs for c in r.cycles for gain in c["total_gain"]]
    margin = 0.05 * (max(every) - min(every) or 1)
    return min(*every, 0.0) - margin, max(every) + margin


def _draw_gains(figure: FigureBase, group: Group, limits: tuple[float, float]) -> None:
    axes = axes_of(figure)
    colour = look(group.label).colour
    cycles = [cycle for run in group.runs for cycle in run.cycles]
    points = np.array([(c["updates"], gain) for c in cycles for gain in c["total_gain"]], float)
    # As pixels also in SVG, where thousands of dots would make the page heavy.
    axes.plot(*points.T, ".", color=colour, ms=3, alpha=0.35, rasterized=True)
    lines: list[tuple[str, Callable[[Any], float], str]] = [
        ("maximum", lambda cycle: float(np.max(cycle["total_gain"])), "-"),
        ("mean", lambda cycle: float(np.mean(cycle["total_gain"])), "--"),
    ]
    for name, reduce, dash in lines:
        x, rows = _per_cycle(group, reduce)
        mean = np.nanmean(rows, 0)
        axes.plot(x, mean, dash, color=colour, label=f"{name} of the copies")
    axes.axhline(0, color="0.2", linewidth=0.8)
    axes.set(
        title=group.label,
        ylim=limits,
        xlabel="Solver updates",
        ylabel=f"total gain in target {_measure(group)}",
    )
    axes.legend(loc="best")


def _draw_strip(figure: FigureBase, group: Group) -> None:
    found = _histograms(group)
    assert found is not None
    updates, shares = found
    stages = sorted({round(i) for i in np.linspace(0, len(shares) - 1, STAGES)})
    row = figure.subplots(1, len(stages), squeeze=False, sharey=True)[0]
    for axes, stage in zip(row, stages, strict=True):
        mesh = _draw_map(axes, shares[stage], group.runs[0], shares.max(), edge=axes is row[0])
        axes.set_title(f"update {updates[stage]:.0f}", fontsize=9)
    figure.suptitle(group.label, fontsize=10, x=0.01, ha="left")
    _colour_bar(figure, mesh, list(row), shares[0].size, shares.max())


def _draw_map(axes: Axes, share: Column, run: Run, largest: float, edge: bool) -> Any:
    fractions, lengths = _space(run)
    # White is the uniform distribution, orange more than that, purple less.
    even = 1 / share.size
    norm = TwoSlopeNorm(even, 0, max(largest, 2 * even))
    mesh = axes.pcolormesh(share, cmap="PuOr_r", norm=norm)
    axes.set_xticks(np.arange(len(lengths)) + 0.5, [f"{length:g}" for length in lengths])
    axes.set_yticks(np.arange(len(fractions)) + 0.5, [f"{fraction:g}" for fraction in fractions])
    axes.tick_params(labelsize=7, length=0)
    axes.grid(visible=False)
    axes.set_xlabel("path length (moves)", fontsize=8)
    if edge:
        axes.set_ylabel("obstacle fraction", fontsize=8)
    return mesh


def _colour_bar(figure: FigureBase, mesh: Any, axes: Any, bins: int, largest: float) -> None:
    bar = figure.colorbar(mesh, ax=axes, format=lambda value, _: f"{value:.1%}")
    bar.set_ticks([0, 1 / bins, max(largest, 2 / bins)])
    bar.set_label("share of proposals", fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _gif(animation: FuncAnimation) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "animation.gif"
        animation.save(file, writer=PillowWriter(fps=round(1 / FRAME_SECONDS)), dpi=100)
        return file.read_bytes()


def _draw_scalar(figure: FigureBase, groups: Sequence[Group], name: str, axis: str) -> None:
    _draw_over_cycles(figure, groups, lambda cycle: _number(cycle.get(name)), axis)


def _draw_ratio(figure: FigureBase, groups: Sequence[Group]) -> None:
    def ratio(cycle: Mapping[str, Any]) -> float:
        points = np.asarray(cycle["total_gain"], float)
        spread = float(points.std(ddof=1)) if len(points) > 1 else 0.0
        return float(points.mean()) / spread if spread else np.nan

    _draw_over_cycles(figure, groups, ratio, "total gain: mean / sd of copies")


def _draw_over_cycles(
    figure: FigureBase,
    groups: Sequence[Group],
    value: Callable[[Mapping[str, Any]], float],
    axis: str,
) -> None:
    axes = axes_of(figure)
    means = [draw_curve(axes, *_per_cycle(group, value), group.label) for group in groups]
    focus(axes, means)
    axes.set(xlabel="Solver updates", ylabel=axis)


def _per_cycle(group: Group, value: Callable[[Mapping[str, Any]], float]) -> tuple[Column, Column]:
    """A number of every cycle: the Solver's updates [n] and the values [runs, n]."""
    x = np.unique([float(cycle["updates"]) for run in group.runs for cycle in run.cycles])
    rows = np.full((len(group.runs), len(x)), np.nan)
    for row, run in zip(rows, group.runs, strict=True):
        for cycle in run.cycles:
            row[np.searchsorted(x, float(cycle["updates"]))] = value(cycle)
    return x, rows


def _histograms(group: Group) -> tuple[Column, Column] | None:
    """Shares of proposals by cycle, [cycles, fractions, lengths], mean over the runs."""
    by_updates: dict[float, list[Column]] = {}
    for run in group.runs:
        for cycle in run.cycles:
            share = proposal_shares(run, cycle)
            if share is not None:
                by_updates.setdefault(float(cycle["updates"]), []).append(share)
    if not by_updates:
        return None
    updates = sorted(by_updates)
    return np.array(updates), np.array([np.mean(by_updates[u], 0) for u in updates])


def proposal_shares(run: Run, cycle: Mapping[str, Any]) -> Column | None:
    """Shares of a cycle's proposals, [fractions, lengths]; None if none were recorded."""
    if "histogram" not in cycle:
        return None
    counts = np.asarray(cycle["histogram"], float)
    fits = counts.shape == tuple(len(side) for side in _space(run))
    return counts / counts.sum() if fits and counts.sum() > 0 else None


def _space(run: Run) -> tuple[Column, Column]:
    space = run.config["space"]
    return np.asarray(space["obstacle_fractions"], float), np.asarray(space["path_lengths"], float)


def _number(value: Any) -> float:
    """A recorded number; NaN where the cycle has none."""
    return float(value) if isinstance(value, int | float) else np.nan


def _scalars(cycle: Any) -> list[str]:
    return [n for n, v in cycle.items() if isinstance(v, int | float) and n not in PLACE]
