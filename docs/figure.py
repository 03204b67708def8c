"""Draws the README's figure from the published runs: ``.venv/bin/python docs/figure.py``."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
from PIL import Image

from proposer_rl.report.statistics import median_of

RESULTS = Path(__file__).parents[1] / "results" / "medium"
# Method and label of its variant, text, colour.
SHOWN = [
    ("hand_designed", "filtered", "hand-designed, filtered", "#56B4E9"),
    ("first_order_gain", "none", "first-order gain (filtered)", "#AA3377"),
    ("ncc", "none", "NCC", "#009E73"),
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
    file = Path(__file__).parent / "learning_curves.png"
    figure.savefig(file, dpi=100)
    Image.open(file).convert("RGB").quantize(64).save(file, optimize=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
