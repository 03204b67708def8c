"""Draws the figures of the README and of the pages on how it works and on terrain levels.

``.venv/bin/python docs/figure.py``
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from PIL import Image

from proposer_rl.report.statistics import median_of

RESULTS = Path(__file__).parents[1] / "results" / "medium"
# Method and label of its variant, text, colour.
SHOWN = [
    ("hand_designed", "filtered", "hand-designed, filtered", "#56B4E9"),
    ("first_order_gain", "none", "first-order gain (filtered)", "#AA3377"),
    ("ncc", "none", "NCC", "#009E73"),
    ("adaptive_mixture", "none", "adaptive mixture (no oracle)", "#332288"),
    ("model_transport", "none", "model transport (no oracle)", "#0072B2"),
    ("perf_gain", "none", "performance gain (the paper's)", "#D55E00"),
    ("domain_randomization", "none", "domain randomization", "#555555"),
    ("plr", "none", "PLR", "#999933"),
    ("target", "none", "target alone", "#000000"),
]


def main(results: Path = RESULTS) -> None:
    """Draw success on the target, as median and its interval over seeds, to learning_curves.png."""
    runs = pd.read_csv(results / "runs.csv.xz")[["run", "method", "ablation"]]
    metrics = pd.read_csv(results / "metrics.csv.xz").merge(runs, on="run")
    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    ends = []
    for method, ablation, text, colour in SHOWN:
        own = metrics[(metrics["method"] == method) & (metrics["ablation"] == ablation)]
        seeds = own.pivot_table(index="updates", columns="seed", values="id_success")
        median, low, high = median_of(seeds.T)
        axes.plot(seeds.index, median, color=colour, lw=2)
        axes.fill_between(seeds.index, low, high, color=colour, alpha=0.2, lw=0)
        ends.append((median[-1], text, colour))
    place = 1.03
    for end, text, colour in sorted(ends, reverse=True):  # labels at the ends, without overlap
        place = min(end, place - 0.06)
        axes.annotate(text, (405, place - 0.02), color=colour, annotation_clip=False, fontsize=9)
    axes.set(
        xlim=(0, 400), ylim=(0, 1), xlabel="updates of the Solver", ylabel="success on the target"
    )
    axes.spines[["top", "right"]].set_visible(False)
    _save(figure, "learning_curves.png")


def terrain_levels(rows: int = 10) -> None:
    """Draw where robots are in the long run, by the rule of legged_gym, to terrain_levels.png."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8, 2.8), layout="constrained")
    for shift, success in enumerate((1.0, 0.8, 0.6)):
        places = np.arange(rows) + 0.27 * (shift - 1)
        left.bar(places, _stationary(success, rows), 0.27, label=f"success {success:.0%}")
    left.set(xlabel="row", ylabel="share of the episodes", xticks=range(rows))
    left.legend(frameon=False)
    chances = np.linspace(0, 1, 101)
    right.plot(chances, [_stationary(p, rows) @ np.arange(rows) for p in chances], lw=2)
    right.axhline(2 * (rows - 1) / 3, color="#555555", lw=1, ls=":")
    right.set(xlabel="success in every row", ylabel="mean level", xlim=(0, 1), ylim=(0, rows - 1))
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    _save(figure, "terrain_levels.png")


def _stationary(success: float, rows: int) -> np.ndarray:
    """Return the shares of the rows in the long run, with the same success in all of them."""
    up, down = np.eye(rows, k=1), np.eye(rows, k=-1)
    up[-1], down[0, 0] = 1 / rows, 1
    chain = success * up + (1 - success) * down
    balance = np.vstack([chain.T - np.eye(rows), np.ones(rows)])
    return np.linalg.lstsq(balance, np.eye(rows + 1)[-1])[0]


def how_it_works() -> None:
    """Draw the two loops, one inside the other, to how_it_works.png."""
    figure, axes = plt.subplots(figsize=(8, 4.4), layout="constrained")
    axes.set(xlim=(0, 100), ylim=(-5, 54))
    axes.axis("off")
    for x, y, width, height, colour in (
        (34, 4, 64, 48, "#FFF3E6"),
        (38, 7, 56, 23, "#E6F0F8"),
    ):
        box = FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0.6", fc=colour, ec="none")
        axes.add_patch(box)
    for x, y, width, height, colour, text in (
        (3, 20, 23, 15, "#D55E00", "Proposer\n(teacher)\na PPO agent"),
        (40, 12, 20, 12, "#0072B2", "Solver\n(student)\na PPO agent"),
        (72, 12, 20, 12, "#555555", "levels\nfor example mazes"),
    ):
        box = FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0.6", fc=colour, ec="none")
        axes.add_patch(box)
        middle = x + width / 2, y + height / 2
        axes.text(*middle, text, color="white", ha="center", va="center", fontsize=10)
    for start, end, bend in (
        ((61, 21), (71, 21), 0),
        ((71, 15), (61, 15), 0),
        ((15, 36), (82, 25.5), -0.38),
        ((50, 10.5), (15, 19), -0.25),
    ):
        style = f"arc3,rad={bend}"
        arrow = FancyArrowPatch(
            start, end, connectionstyle=style, arrowstyle="-|>", mutation_scale=16, color="black"
        )
        axes.add_patch(arrow)
    for x, y, text, where in (
        (66, 22, "action", "center"),
        (66, 9.6, "observation,\nreward", "center"),
        (40, 26.5, "inner loop: a step is a move", "left"),
        (36, 49, "outer loop: a step is an update of the Solver", "left"),
        (36, 34, "action: which levels\nthe Solver trains on", "left"),
        (
            24,
            -4,
            "observation: what the Solver does on probe levels\n"
            "reward: how much its return on the target rose",
            "center",
        ),
    ):
        axes.text(x, y, text, ha=where, fontsize=9)
    _save(figure, "how_it_works.png")


def _save(figure: plt.Figure, name: str) -> None:
    file = Path(__file__).parent / name
    figure.savefig(file, dpi=100)
    Image.open(file).convert("RGB").quantize(64).save(file, optimize=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
    terrain_levels()
    how_it_works()
