"""The numbers that the page's charts are drawn from, against the runs' own files."""

from __future__ import annotations

import base64
import csv
import io
import statistics
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from proposer_rl.report import build, page
from proposer_rl.report.build import write_report
from proposer_rl.report.figures import learning_curves
from proposer_rl.report.measures import own_numbers
from proposer_rl.report.studies import read_studies
from proposer_rl.report.style import render
from tests.report.folders import TASK, cycle, page_data, png, write_jsonl, write_run

SEEDS = 6
UPDATES, FRAMES, SECONDS = (
    "Solver updates",
    "environment frames, millions (all)",
    "wall-clock seconds",
)


def rows_of(folder: Path) -> list[dict[str, float]]:
    with (folder / "metrics.csv").open(encoding="utf-8") as file:
        return [{name: float(text) for name, text in row.items()} for row in csv.DictReader(file)]


def median_and_interval(values: list[float]) -> list[float]:
    """Of six runs: the lowest and the highest."""
    return [statistics.median(values), min(values), max(values)]


def between(x: float, xs: list[float], ys: list[float]) -> float:
    """The ordinate of a polygon, by hand."""
    i = max(k for k in range(len(xs) - 1) if xs[k] <= x)
    return ys[i] + (ys[i + 1] - ys[i]) * (x - xs[i]) / (xs[i + 1] - xs[i])


def by_name(items: list[dict[str, Any]], name: str) -> dict[str, Any]:
    (found,) = (item for item in items if item["name"] == name)
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    random = np.random.default_rng(3)
    for method, copies in (("mine", 700), ("target", 0)):
        for seed in range(SEEDS):
            curve = np.sort(random.uniform(0, 1, 5)).round(4).tolist()
            write_run(folder / f"{method}{seed}", method, [seed], curve, copies=copies)
    return folder


@pytest.fixture(scope="module")
def data(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "DRAWINGS", [])
        written = write_report([runs], tmp_path_factory.mktemp("out") / "report")
    (found,) = page_data(written)
    return found


def test_lines_and_bands_are_median_and_interval_of_the_files(
    runs: Path, data: dict[str, Any]
) -> None:
    measure = by_name(data["measures"], "ID success rate")
    for place, method in enumerate(["mine", "target"]):
        assert data["methods"][place]["label"] == method
        folders = [rows_of(runs / f"{method}{seed}") for seed in range(SEEDS)]
        series = measure["axes"][UPDATES][place]
        assert series["x"] == [row["updates"] for row in folders[0]]
        expected = [
            median_and_interval([r["id_success"] for r in at]) for at in zip(*folders, strict=True)
        ]
        found = np.transpose([series["median"], series["low"], series["high"]])
        assert found == pytest.approx(np.array(expected), abs=2e-5)
        assert series["rows"] == [[r["id_success"] for r in rows] for rows in folders]
        assert series["seeds"] == list(range(SEEDS))


def test_against_a_cost_runs_stand_between_their_measurements(
    runs: Path, data: dict[str, Any]
) -> None:
    by_name(data["measures"], "ID success rate on the worst 10 %")
    measure = by_name(data["measures"], "ID success rate")
    costs = {
        FRAMES: lambda row: (row["frames"] + row["curriculum_frames"]) / 1e6,
        SECONDS: lambda row: row["seconds"],
    }
    folders = [rows_of(runs / f"mine{seed}") for seed in range(SEEDS)]
    for axis, cost in costs.items():
        series = measure["axes"][axis][0]
        for i in (1, 20, 50, 98):
            values = [
                between(series["x"][i], [cost(r) for r in rows], [r["id_success"] for r in rows])
                for rows in folders
            ]
            assert [row[i] for row in series["rows"]] == pytest.approx(values, abs=1e-4)
            found = [series["median"][i], series["low"][i], series["high"][i]]
            assert found == pytest.approx(median_and_interval(values), abs=1e-4)


def test_outcomes_are_those_that_decide(runs: Path, data: dict[str, Any]) -> None:
    outcome = data["outcomes"][0]
    assert outcome["name"] == "ID success, mean over 40 updates"
    values = []
    for seed in range(SEEDS):
        y = [row["id_success"] for row in rows_of(runs / f"mine{seed}")]
        values.append(sum((a + b) / 2 for a, b in pairwise(y)) / 4)
    assert outcome["methods"][0]["values"] == pytest.approx(values, abs=2e-5)
    assert outcome["methods"][0]["mean"] == pytest.approx([statistics.fmean(values)], abs=2e-5)


@pytest.mark.usefixtures("undrawn")
def test_what_is_not_known_is_null(tmp_path: Path) -> None:
    """A short run leaves a median that is not of all, and few seeds have no interval."""
    write_run(tmp_path / "a", seeds=[0])
    write_run(tmp_path / "b", seeds=[1], curve=[0.0, 0.1], finished=False)
    (data,) = page_data(write_report([tmp_path], tmp_path / "out"))
    (series,) = by_name(data["measures"], "ID success rate")["axes"][UPDATES]
    assert series == {
        "x": [0, 10, 20],
        "median": [0, 0.3, 0.9],
        "whole": [True, True, False],
        "low": [None] * 3,
        "high": [None] * 3,
        "seeds": [0, 1],
        "rows": [[0, 0.5, 0.9], [0, 0.1, None]],
    }
    assert data["outcomes"][0]["methods"][0]["values"][1] is None


@pytest.mark.usefixtures("undrawn")
def test_stages_move_proposals_levels_and_success_together(tmp_path: Path) -> None:
    maps = [[[6, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 3, 3]]]
    cycles = [cycle(i, [0.1], maps[i], every=20) for i in range(2)]
    curve = [0.0, 0.2, 0.4, 0.6]
    task = {**TASK, "space": {"ground": ["flat", "stairs"], "path length": [2, 3, 4]}}
    write_run(tmp_path / "p", "perf_gain", [4], curve, cycles=cycles, task=task)
    write_run(tmp_path / "t", "target", [4], curve, task=task)
    (data,) = page_data(write_report([tmp_path], tmp_path / "out"))
    found, plain = data["stages"]["methods"]
    assert found["curve"] == [[0, 10, 20, 30], curve]
    assert [stage["updates"] for stage in found["stages"]] == [10, 20, 30]
    # The last map on record: that of update 0, then that of update 20.
    assert [stage["map"][0][0] for stage in found["stages"]] == [1, 0, 0]
    assert found["stages"][2]["map"][1] == [0, 0.5, 0.5]
    assert all(stage["map"] is None for stage in plain["stages"])
    # One picture, wherever it is shown.
    assert len(data["stages"]["pictures"]) == 1
    assert found["stages"][0]["levels"] == [0, 0, 0] == plain["stages"][2]["levels"]
    assert data["stages"]["first"] == 0
    axes = {axis["name"]: axis["values"] for axis in data["stages"]["axes"]}
    assert axes == {"ground": ["flat", "stairs"], "path length": [2, 3, 4]}
    # Without levels, as in a published study, the map moves alone.
    (tmp_path / "p" / "curriculum.jsonl").unlink()
    (data,) = page_data(write_report([tmp_path], tmp_path / "out"))
    alone = data["stages"]["methods"][0]["stages"]
    assert [stage["map"] and stage["map"][0][0] for stage in alone] == [1, 0]
    assert [(stage["updates"], stage["levels"]) for stage in alone] == [(0, []), (20, [])]


def test_methods_keep_their_colours_in_still_figures(runs: Path) -> None:
    (study,), _ = read_studies(sorted(runs.iterdir()), None)
    drawing = learning_curves(study)
    image = page.figure(drawing, *render(drawing, "png"))
    content = base64.b64decode(image["address"].removeprefix("data:image/png;base64,"))
    with Image.open(io.BytesIO(content)) as file:
        found = np.asarray(file.convert("RGB")).astype(int)
    for look in study.legend.values():
        colour = list(bytes.fromhex(look.colour[1:]))
        assert (np.abs(found - colour).max(-1) <= 8).any(), colour


SIZE = 4 * 2**20
FIGURES = 2**20  # more than the pictures of 9 methods take


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_page_of_many_long_runs_stays_small(tmp_path: Path) -> None:
    """9 methods x 5 seeds with 76 evaluations each; noise, which cannot be packed."""
    random = np.random.default_rng(0)
    cost = ["frames", "curriculum_frames", "evaluations", "seconds"]
    names = [f"{d}_{kind}" for d in ("id", "ood") for kind in ("success", "return", "worst10")]
    for number in range(9):
        for seed in range(5):
            folder = write_run(tmp_path / f"m{number}-{seed}", f"method_{number}", [seed], [0.0])
            costs = np.sort(random.uniform(0, 1e6, (76, 4)), 0)
            values = np.c_[np.full(76, seed), 10 * np.arange(76), costs, random.random((76, 6))]
            header = ["seed", "updates", *cost, *names]
            save(folder / "metrics.csv", header, values)
            trained = np.c_[np.full(76, seed), 10 * np.arange(76), random.random((76, 4))]
            save(folder / "training.csv", ["seed", "updates", *"abcd"], trained)
        sample = [{"picture": png(random.integers(0, 256, (40, 40, 3)))} for _ in range(4)]
        lines = [{"updates": 10 * i, "seed": 0, "levels": sample} for i in range(1, 76)]
        write_jsonl(tmp_path / f"m{number}-0" / "curriculum.jsonl", lines)
    written = write_report([tmp_path], tmp_path / "out")
    (data,) = page_data(written)
    assert len(data["methods"]) == 9
    assert len(data["measures"][0]["axes"][UPDATES][0]["rows"]) == 5
    assert written.stat().st_size < SIZE - FIGURES


def save(path: Path, header: list[str], values: Any) -> None:
    np.savetxt(path, values, "%.17g", ",", header=",".join(header), comments="")


@pytest.mark.usefixtures("undrawn")
def test_pictures_that_are_too_large_are_fewer_or_none(tmp_path: Path) -> None:
    random = np.random.default_rng(0)

    def noise() -> str:
        return png(random.integers(0, 256, (160, 160, 3)))

    for count, expected in ((1, 10), (4, None)):
        folder = write_run(tmp_path / f"r{count}", seeds=[0], task={**TASK, "measured": count})
        lines = [
            {"updates": i, "seed": 0, "levels": [{"picture": noise()} for _ in range(count)]}
            for i in range(12)
        ]
        write_jsonl(folder / "curriculum.jsonl", lines)
        (data,) = page_data(write_report([folder], tmp_path / f"o{count}"))
        shown = data["stages"] and data["stages"]["methods"][0]["stages"]
        assert (shown and len(shown)) == expected


def test_shares_of_batches_are_curves_over_updates(tmp_path: Path) -> None:
    """Of each name; where a cycle tells none there is a gap."""
    told = [{"way": [0.2, 0.4], "rest": 0.7}, {"rest": [1.0]}, {"way": 0.5, "rest": [0.5]}]
    cycles = [{"updates": 10 * i, "shares": shares} for i, shares in enumerate(told)]
    write_run(tmp_path / "run", cycles=cycles)
    (study,), _ = read_studies([tmp_path / "run"], None)
    found = {one.name: one for one in own_numbers(study)}
    series = found["shares/way"].axes[UPDATES](study.groups[0])
    assert found.keys() == {"shares/way", "shares/rest"}
    assert all(one.rate for one in found.values())
    assert series is not None and series.columns.tolist() == [0, 10, 20]
    np.testing.assert_allclose(series.to_numpy()[0], [0.3, np.nan, 0.5])
