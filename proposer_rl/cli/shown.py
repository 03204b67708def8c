"""The picture and the lines with which a run ends, and the table with which a sweep does.

Training is given this module and knows nothing of what draws; figures take a while to import.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from proposer_rl.cli.errors import say
from proposer_rl.report.terminal import find_progress, overview
from proposer_rl.runs.folder import is_rate
from proposer_rl.runs.records import level_text


def show_sweep(folder: Path) -> None:
    """Lists the runs of a sweep that is over."""
    Console().print(overview(find_progress(folder)))


def draw_run(folder: Path, title: str) -> Path:
    """Draws ``run.png`` of a run's folder; returns the file."""
    from proposer_rl.report import figures

    return figures.draw_run(folder, title)


def show_run(folder: Path, name: str, result: Mapping[str, Any]) -> None:
    """Draws the picture of a run that is over, and prints its summary."""
    picture, seeds = draw_run(folder, name), result["seeds"]
    for seed, reached, final in zip(
        seeds, result["updates_to_threshold"], result["final"], strict=True
    ):
        say(f"{result['method']}, seed {seed}: {_outcome_text(result, reached, final)}")
    say(_cost_text(result, len(seeds)))
    say(f"Files: {folder}  (picture: {picture.name})")


def _outcome_text(
    result: Mapping[str, Any], reached: int | None, final: Mapping[str, float]
) -> str:
    headline = result["headline"]
    level = f"{level_text(headline, result['threshold'])} {headline.replace('_', ' ')}"
    end = f"{final[headline]:.1%}" if is_rate(headline) else f"{final[headline]:.3g}"
    outcome = (
        f"{level} after {reached} updates"
        if reached is not None
        else f"{level} not reached in {result['updates']} updates (censored)"
    )
    return f"{outcome}; {end} at the end."


def _cost_text(result: Mapping[str, Any], seeds: int) -> str:
    together = f" for each of {seeds} seeds" if seeds > 1 else ""
    return (
        f"Cost: {result['frames']:,} frames of the Solver{together}, "
        f"{result['curriculum_frames']:,} of its curriculum, {result['seconds']:.0f} s."
    )
