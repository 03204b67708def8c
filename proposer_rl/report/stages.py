"""The way through training as JSON: proposals, levels and success of a method at one moment."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image

from proposer_rl.report.charts import plain
from proposer_rl.report.records import LevelRecord, number, picture
from proposer_rl.report.runs import Run, share_map
from proposer_rl.report.studies import Study

Json = Any
LEVELS = 4  # of a batch
SIDE = 160  # pixels of a picture, at most
# How many stages of a method are shown: as many as fit.
STAGES = (40, 20, 10, 5)
MOST_BYTES = 2**20  # of all pictures of a study


def stages(study: Study) -> dict[str, Json] | None:
    """What the page's slider shows: of every method one run, the first that recorded levels.

    Where none of a method's runs did, the first that recorded proposals.

    Returns:
        ``axes``: names and values of the space of levels, at most two. ``pictures``: each once, a
        PNG in base64. ``methods``: for every method null or the ``seed``, the ``curve`` of its
        headline and the ``stages``: updates, ``levels`` (the number of a picture, or lines of
        text) and ``map``, the last record of what was proposed (rows of shares) or null.
        ``first``: the number of the method to begin with. None where no run recorded either, or
        the pictures are too large for a page.
    """
    like = study.example
    runs = [
        next((run for run in group.runs if run.samples), None)
        or next(
            (run for run in group.runs if any(like.shares(c) is not None for c in run.cycles)), None
        )
        for group in study.groups
    ]
    for most in STAGES:
        pictures: dict[str, int] = {}
        methods = [None if run is None else _method(run, study, most, pictures) for run in runs]
        if sum(map(len, pictures)) <= MOST_BYTES:
            break
    else:
        return None
    shown = {number: method for number, method in enumerate(methods) if method is not None}
    if not shown:
        return None
    proposed = [number for number, method in shown.items() if method["stages"][-1]["map"]]
    axes = [
        {"name": name, "values": plain(values)}
        for name, values in list(like.task.space.items())[:2]
    ]
    return {
        "axes": axes,
        "pictures": list(pictures),
        "methods": methods,
        "first": next(iter([*proposed, *shown])),
    }


def _method(run: Run, study: Study, most: int, pictures: dict[str, int]) -> dict[str, Json]:
    moments: list[tuple[int, Sequence[LevelRecord]]] = [(s.updates, s.levels) for s in run.samples]
    if not moments:
        recorded = [c for c in run.cycles if number(c.get("seed", run.seed)) == run.seed]
        moments = [
            (updates, ()) for updates in sorted({int(number(c["updates"])) for c in recorded})
        ]
    last = len(moments) - 1
    chosen = np.unique(np.linspace(0, last, min(most, len(moments))).round()).astype(int)
    curve = (run.metrics["updates"], run.metrics[study.headline])
    return {
        "seed": run.seed,
        "curve": [plain(values) for values in curve],
        "stages": [
            {
                "updates": moments[i][0],
                "levels": [_level(level, pictures) for level in moments[i][1][:LEVELS]],
                "map": _map(run, study.example, moments[i][0]),
            }
            for i in chosen
        ],
    }


def _level(level: LevelRecord, pictures: dict[str, int]) -> Json:
    image = picture(level.picture)
    if image is None:
        return level.text
    return pictures.setdefault(_small(image), len(pictures))


def _small(pixels: Any) -> str:
    """A picture as PNG in base64, no larger than what is shown of it."""
    image, file = Image.fromarray(pixels), io.BytesIO()
    image.thumbnail((SIDE, SIDE))
    image.save(file, format="PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def _map(run: Run, like: Run, updates: int) -> Json:
    """The last shares of proposals that were on record after that many updates."""
    shares = [
        found
        for cycle in run.cycles
        if number(cycle["updates"]) <= updates
        and number(cycle.get("seed", run.seed)) == run.seed
        and (found := like.shares(cycle)) is not None
    ]
    return [plain(row) for row in share_map(shares[-1])] if shares else None
