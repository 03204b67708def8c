"""Folders as runs leave them, with outcomes of our choice, of two tasks."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from proposer_rl.report.studies import Study, read_studies
from proposer_rl.runs.folder import RunFolder
from research.benchmarks.results import Result, Row, Spread

EVERY = 10  # updates between two evaluations


def png(pixels: Any, **options: Any) -> str:
    """An array of uint8 [H, W, 3] as a record holds it."""
    file = io.BytesIO()
    Image.fromarray(np.asarray(pixels, np.uint8)).save(file, format="PNG", **options)
    return base64.b64encode(file.getvalue()).decode()


PIXELS = np.random.default_rng(0).integers(0, 256, (20, 40, 3), np.uint8)
LEVEL = {"picture": png(PIXELS), "text": [". . # .", "S • • G"], "path": [[1, 0], [1, 1]]}
TASK: dict[str, Any] = {
    "title": "2×4 mazes",
    "distributions": ["id", "ood"],
    "space": {"obstacle fraction": [0.0, 0.2], "path length": [2, 3, 4]},
    "about": {"Mazes": "2×4, at most 9 steps"},
    "measured": {"id": [[0.1, 3]], "levels": 8},
    "levels": "mazes",
    "key": "Blue: start.",
    "text_key": "S start, G goal",
}
# Of another kind: one axis, no success, no text, pictures of another size.
ROCKETS: dict[str, Any] = {
    "title": "rockets",
    "distributions": ["target"],
    "space": {"thrust": [1, 2, 4, 8]},
    "measured": 3,
    "levels": "rockets",
}


def config(method: str, seed: int, **changes: Any) -> dict[str, Any]:
    return {
        "method": method,
        "scale": "tiny",
        "ablation": "none",
        "curriculum": {"_target_": "some.factory"},
        "seed": seed,
        "seeds": [seed],
        "task": {"_target_": "some.task", "size": 2},
        "solver": {"batch_size": 8},
        "proposer": {"rollouts": 2},
        "schedule": {"headline": "id_success", "threshold": 0.8, "cycle_length": 20},
        "lifetimes": 1,
        "checkpoint": None,
        "precision": "fp32",
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
    asked: int = 3,
    task: dict[str, Any] = TASK,
    levels: Sequence[float] = (),
    facts: dict[str, Any] | None = None,
    **changes: Any,
) -> Path:
    """A run whose measurement on every distribution is ``curve``, one value per evaluation.

    At every update the curriculum spends ``copies`` frames and ``asked`` evaluations. ``levels`` is
    what is reached on every single level at the end, on every distribution.
    """
    run = RunFolder(folder)
    settings = config(method, seeds[0], **{"seeds": list(seeds), **changes})
    run.write_json("config.json", settings)
    kind = settings["schedule"]["headline"].rpartition("_")[2]
    level = LEVEL if task is TASK else {"picture": png(np.full((8, 8, 3), 7))}
    for i, value in enumerate(curve):
        updates = EVERY * i
        for seed in seeds:
            cost = {
                "frames": 100 * updates,
                "curriculum_frames": copies * updates,
                "evaluations": asked * updates,
                "seconds": 2.0 * i,
            }
            measured = {f"{name}_{kind}": float(value) for name in task["distributions"]}
            if kind == "success":
                measured |= {f"{name}_worst10": value / 2 for name, value in measured.items()}
            run.append("metrics.csv", {"seed": seed, "updates": updates, **cost, **measured})
            if i:
                batch = {"path_length": 3.0, "train_success": value} if task is TASK else {}
                training = {**batch, "fuel": -float(i), "loss_critic": 0.5, "entropy": 1.0}
                run.append("training.csv", {"seed": seed, "updates": updates, **training})
                row = {"updates": updates, "seed": seed, "levels": [level] * 3}
                run.append("curriculum.jsonl", row)
    for cycle in cycles:
        run.append("cycles.jsonl", cycle)
    updates = EVERY * (len(curve) - 1)
    for seed in seeds:
        for name in task["distributions"] if len(levels) else ():
            row = {"seed": seed, "updates": updates, "distribution": name, kind: list(levels)}
            run.append("levels.jsonl", row)
    identity = {
        "versions": {"python": "3.11"},
        "device": "cpu",
        "overrides": [f"+method={method}", f"seed={seeds[0]}", "hydra.run.dir=x"],
        "arguments": {"config_dir": None, "pythonpath": None},
        **(facts or {}),
    }
    run.write_json("run.json", {**identity, "planned_updates": updates, "task": task})
    if finished:
        run.write_json("summary.json", {**identity, "updates": updates})
    return folder


def write_ends(folder: Path, ends: Mapping[str, Sequence[float]], **options: Any) -> Study:
    """A study of methods whose seeds go straight to these ends, in two evaluations."""
    for method, values in ends.items():
        for seed, end in enumerate(values):
            curve = [0.0, end / 2, end]
            write_run(folder / f"{method}{seed}", method, [seed], curve, **options)
    return study_in(folder)


def study_in(folder: Path) -> Study:
    """The study of the runs in a folder."""
    (study,), _ = read_studies(sorted(folder.iterdir()), None)
    return study


def write_rockets(folder: Path, method: str, seed: int, **options: Any) -> Path:
    """A run of the other task, summed up by a return."""
    schedule = {"headline": "target_return", "threshold": 12.5, "cycle_length": 20}
    curve = [-3.0, 10.0 + seed, 20.0]
    return write_run(folder, method, [seed], curve, task=ROCKETS, schedule=schedule, **options)


def cycle(
    number: int, gains: Sequence[float], histogram: Sequence[Any], every: int = 20
) -> dict[str, Any]:
    """A record of a Proposer's cycle."""
    return {
        "cycle": number,
        "updates": every * number,
        "curriculum_frames": 100 * (number + 1),
        "evaluations": 7,
        "return_gain": list(gains),
        "log_success_gain": [2 * gain for gain in gains],
        "total_reward": list(gains),
        "entropy": 1.5,
        "kl_approx": 0.01,
        "histogram": list(histogram),
    }


def page_data(page: Path) -> list[dict[str, Any]]:
    """What is packed into a page for its charts, of each of its sections."""
    packed = re.findall(r'class="data">([^<]*)</script>', page.read_text(encoding="utf-8"))
    return [json.loads(gzip.decompress(base64.b64decode(text))) for text in packed]


def write_jsonl(path: Path, lines: Sequence[Any]) -> None:
    """Lines in place of those of a file."""
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")


def write_seconds(file: Path, seconds: Mapping[str, Sequence[float]]) -> Path:
    """As ``bin/bench curricula --runs`` writes them."""
    row = Row("an update", "of another", Spread.of([2.0]), "x", samples=dict(seconds))
    measured = {"threads": 3, "result": Result([row]).to_json()}
    content = {"machine": {"processor": "abacus"}, "benchmarks": {"curricula": measured}}
    file.write_text(json.dumps(content), encoding="utf-8")
    return file
