"""One picture of a run, drawn from its folder: learning curves and mazes along training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from proposer_rl.mazes import Level, draw_level
from proposer_rl.run_folder import read_csv, read_jsonl

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")  # Okabe and Ito, safe for the colour-blind
STAGES = 5


def draw_run(folder: Path, title: str) -> Path:
    """Draw success on every distribution, and mazes that were trained on with the agent's path.

    Args:
        folder: a run's folder.
        title: of the picture.

    Returns:
        The file, ``run.png`` in the folder.
    """
    metrics = read_csv(folder / "metrics.csv")
    samples = _stages(read_jsonl(folder / "curriculum.jsonl"))
    figure = Figure(figsize=(9, 3 + 1.3 * len(samples)), layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=[3, 1.3 * len(samples)])[
        :, 0
    ]
    _draw_curves(top.subplots(), metrics)
    top.suptitle(title)
    mazes = max(len(sample["levels"]) for sample in samples)
    rows = bottom.subplots(len(samples), mazes, squeeze=False)
    for axes, sample in zip(rows, samples, strict=True):
        _draw_sample(axes, sample)
    bottom.suptitle(
        "Levels trained on (blue: start, orange: goal) and the Solver's first episode there",
        fontsize="medium",
    )
    file = folder / "run.png"
    figure.savefig(file, dpi=110)
    return file


def _stages(samples: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A few samples, evenly over the run, the first and the last among them."""
    count = min(STAGES, len(samples))
    last = len(samples) - 1
    return [samples[round(i * last / max(count - 1, 1))] for i in range(count)]


def _draw_curves(axes: Axes, metrics: Sequence[dict[str, Any]]) -> None:
    updates = [row["updates"] for row in metrics]
    names = [key for key in metrics[0] if key.endswith("_success") and "greedy" not in key]
    for i, name in enumerate(names):
        label = name.removesuffix("_success")
        axes.plot(updates, [row[name] for row in metrics], color=COLOURS[i % 4], label=label)
    axes.set(xlabel="Solver updates", ylabel="success rate", ylim=(0, 1))
    axes.margins(x=0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)


def _draw_sample(axes: Sequence[Axes], sample: dict[str, Any]) -> None:
    for ax in axes:
        ax.set_axis_off()
    for ax, item in zip(axes, sample["levels"], strict=False):
        level = Level.from_text("\n".join(item["level"]))
        ax.imshow(draw_level(level, item["path"]).numpy())
    axes[0].set_title(f"update {sample['updates']}", loc="left", fontsize="small")
