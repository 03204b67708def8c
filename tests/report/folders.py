"""Folders as runs leave them, with outcomes of our choice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from proposer_rl.runs.folder import RunFolder

EVERY = 10  # updates between two evaluations
LEVEL = {"level": ["..#.", "S..G"], "path": [[1, 0], [1, 1], [1, 2], [1, 3]]}


def config(method: str, seed: int, **changes: Any) -> dict[str, Any]:
    specification = {"specifications": [[0.1, 3]], "mechanism": "uniform"}
    return {
        "method": method,
        "scale": "tiny",
        "ablation": "none",
        "seed": seed,
        "maze": {"height": 2, "width": 4, "max_steps": 9},
        "distributions": {"id": specification, "ood": specification},
        "target": "id",
        "space": {"obstacle_fractions": [0.0, 0.2], "path_lengths": [2, 3, 4]},
        "proposer": {"rollouts": 2},
        "schedule": {"headline": "id_success", "threshold": 0.8, "cycle_length": 20},
        "evaluation": {"distributions": ["id", "ood"], "levels": 8, "seed": 0},
        **changes,
    }


def write_run(
    folder: Path,
    method: str = "target",
    seeds: Sequence[int] = (0,),
    curve: Sequence[float] = (0.0, 0.5, 0.9),
    *,
    finished: bool = True,
    cycles: Sequence[dict[str, Any]] = (),
    copies: int = 0,
    **changes: Any,
) -> Path:
    """A run whose success on every distribution is ``curve``, one value per evaluation."""
    run = RunFolder(folder)
    run.write_json("config.json", config(method, seeds[0], **changes))
    for i, success in enumerate(curve):
        updates = EVERY * i
        for seed in seeds:
            cost = {"frames": 100 * updates, "meta_frames": copies * updates, "seconds": 2.0 * i}
            measured = {f"{name}_success": float(success) for name in ("id", "ood")}
            measured |= {f"{name}_worst10": value / 2 for name, value in measured.items()}
            run.append("metrics.csv", {"seed": seed, "updates": updates, **cost, **measured})
            if i:
                batch = {"obstacle_fraction": 0.1, "path_length": 3.0, "train_success": success}
                run.append("training.csv", {"seed": seed, "updates": updates, **batch})
                run.append(
                    "curriculum.jsonl", {"updates": updates, "seed": seed, "levels": [LEVEL] * 3}
                )
    for cycle in cycles:
        run.append("proposer.jsonl", cycle)
    updates = EVERY * (len(curve) - 1)
    facts = {
        "versions": {"python": "3.11"},
        "device": "cpu",
        "overrides": [f"+method={method}", f"seed={seeds[0]}", "hydra.run.dir=x"],
    }
    run.write_json("run.json", {**facts, "planned_updates": updates})
    if finished:
        run.write_json("summary.json", {**facts, "updates": updates})
    return folder


def cycle(
    number: int, gains: Sequence[float], histogram: Sequence[Sequence[int]], every: int = 20
) -> dict[str, Any]:
    """A record of a Proposer's cycle."""
    return {
        "cycle": number,
        "updates": every * number,
        "meta_frames": 100 * (number + 1),
        "total_gain": list(gains),
        "entropy": 1.5,
        "kl_approx": 0.01,
        "signal_to_noise": 0.3,
        "histogram": [list(row) for row in histogram],
    }
