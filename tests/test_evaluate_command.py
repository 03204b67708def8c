"""``bin/eval`` as users call it, on a run of a few updates."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from proposer_rl.cli.eval import SHOWN, Evaluation, _print, main
from proposer_rl.runs.checkpoint import load_latest, save_checkpoint
from proposer_rl.runs.folder import read_csv, read_jsonl
from proposer_rl.task import LevelResult
from proposer_rl.tasks.mazes.drawings import SETS, read_levels

KEYS = ["success", "return", "greedy_success", "greedy_return"]


@pytest.fixture
def evaluate(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Calls the command; returns its exit code and what it said."""

    def call(*arguments: object) -> tuple[int, str]:
        code = 0
        try:
            main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = int(end.code or 0)
        said = capsys.readouterr()
        return code, said.err if code else said.out

    return call


@pytest.mark.parametrize("name", ["ID", "ood"])
def test_a_distribution_gives_the_runs_own_measurements(
    name: str, run: Path, tmp_path: Path, evaluate
) -> None:
    code, said = evaluate(run, "--levels", name, "-o", tmp_path / "rows.json")
    assert code == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    assert len(rows) == 2 * 40
    for measured in read_csv(run / "metrics.csv")[-2:]:
        own = [row for row in rows if row["seed"] == measured["seed"]]
        for key in KEYS:
            mean = sum(row[key] for row in own) / len(own)
            assert mean == pytest.approx(measured[f"{name.lower()}_{key}"], abs=1e-6)
    assert {(row["max_steps"], row["height"], row["updates"]) for row in rows} == {(10, 5, 6)}
    assert f"the {SHOWN} hardest of 40 levels" in said and "mean of 40" in said
    assert "Means over the seeds" in " ".join(said.split())


def test_the_hardest_levels_are_so_for_all_solvers_together(tmp_path: Path, capsys) -> None:
    results = []
    for number in range(SHOWN + 4):  # four that only the second Solver fails at, wholly
        for solver, success in enumerate((1.0, 0.0) if number < 4 else (0.9, 1.0)):
            values = {"success": success, "return": success}
            results.append(LevelResult(f"<{number}>", solver, {}, values))
    run = SimpleNamespace(folder=tmp_path, config=SimpleNamespace(seeds=[0, 1]))
    evaluation = Evaluation(run, 5, "id", results)
    _print(evaluation)
    said = capsys.readouterr().out
    assert f"{SHOWN} hardest of {SHOWN + 4} levels" in " ".join(said.split())
    shown = [int(number) for number in re.findall(r"<(\d+)>", said)]
    assert shown == list(range(SHOWN))  # in their order


@pytest.mark.slow
def test_the_set_that_comes_along(run: Path, tmp_path: Path, evaluate) -> None:
    files = {name: tmp_path / name for name in ("rows.csv", "rows.json")}
    first = evaluate(run, "-o", files["rows.csv"])
    assert first == evaluate(run, "--levels", "shapes", "-o", files["rows.json"])
    assert first[0] == 0 and "spiral_21" in first[1]
    with open(files["rows.csv"], newline="") as file:
        table = list(csv.DictReader(file))
    rows = json.loads(files["rows.json"].read_text())
    for row, cells in zip(rows, table, strict=True):
        assert list(row) == list(cells)
        for key, value in row.items():
            same = isinstance(value, str) and value == cells[key]
            assert same or float(cells[key]) == pytest.approx(value, rel=1e-5)
    levels = read_levels(SETS["shapes"])
    assert [row["level"] for row in rows[::2]] == list(levels)
    for row in rows:
        assert row["max_steps"] == max(10, 2 * row["path_length"])
        assert (row["height"], row["width"]) == tuple(levels[row["level"]].walls.shape)


def test_the_levels_that_a_run_trained_on(run: Path, tmp_path: Path, evaluate) -> None:
    output = tmp_path / "rows.json"
    assert evaluate(run, "--levels", run / "curriculum.jsonl", "-o", output)[0] == 0
    recorded = [
        f"seed_{row['seed']}_update_{row['updates']:05}_{place}"
        for row in read_jsonl(run / "curriculum.jsonl")
        for place in range(1, len(row["levels"]) + 1)
    ]
    rows = json.loads(output.read_text())
    assert recorded and {row["level"] for row in rows} == set(recorded)
    assert len(rows) == 2 * len(recorded)


def test_a_file_of_levels_and_a_step_limit(run: Path, tmp_path: Path, evaluate) -> None:
    (tmp_path / "halls.txt").write_text("[=1+1]\nS....G\n......\n......\n......\n")
    levels, output = tmp_path / "halls.txt", tmp_path / "rows.json"
    limits = {}
    for limit in ((), ("--max-steps", 4), ("--max-steps", 3000)):
        assert evaluate(run, "--levels", levels, "-o", output, *limit)[0] == 0
        row = json.loads(output.read_text())[0]
        limits[row["max_steps"]] = row["success"]
    assert list(limits) == [10, 4, 3000]
    assert limits[4] == 0 < limits[10] < limits[3000]
    assert evaluate(run, "--levels", levels, "-o", tmp_path / "rows.csv")[0] == 0
    with open(tmp_path / "rows.csv", newline="") as file:
        assert {row["level"] for row in csv.DictReader(file)} == {"=1+1"}


def test_one_checkpoint_of_a_run(run: Path, tmp_path: Path, evaluate) -> None:
    file = sorted((run / "checkpoints").glob("*.pt"))[0]
    assert evaluate(file, "-o", tmp_path / "rows.json")[0] == 0
    assert json.loads((tmp_path / "rows.json").read_text())[0]["updates"] == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: holds no checkpoints; give a run's folder"),
        (["{run}/metrics.csv"], "is not a run's folder: it has no config.json"),
        (
            ["{run}", "--levels", "mazes"],
            "--levels mazes: must be one of: shapes, small, a file ",
        ),
        (["{run}", "--levels", "small.txt"], "level 'small': 3x5 cells are too few"),
        (["{run}", "-o", "rows.txt"], "--output rows.txt: must end in .json or .csv"),
        (
            ["{run}", "-o", "no/rows.csv"],
            "--output no/rows.csv: must end in .json or .csv, in a folder",
        ),
        (["{run}", "--max-steps", "0"], "must be a whole number from 1 to 100,000, got '0'"),
    ],
)
def test_bad_input_is_told_in_one_line(
    arguments: list[str], message: str, run: Path, tmp_path: Path, evaluate, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("small.txt").write_text("S....\n.....\n....G")
    before = sorted(tmp_path.iterdir())
    code, said = evaluate(*(word.format(run=run) for word in arguments))
    assert code == 2
    assert message in said.splitlines()[-1] and "Traceback" not in said
    assert sorted(tmp_path.iterdir()) == before


def test_checkpoints_that_do_not_fit_are_refused(run: Path, tmp_path: Path, evaluate) -> None:
    shutil.copytree(run, tmp_path / "run")
    checkpoints = tmp_path / "run" / "checkpoints"
    step, state = load_latest(checkpoints)
    save_checkpoint(checkpoints, step, {**state, "solver": {}})
    code, said = evaluate(tmp_path / "run")
    assert code == 2 and "checkpoint: the snapshot belongs to another network" in said
    damaged = next(checkpoints.glob("*.pt"))
    damaged.write_bytes(damaged.read_bytes()[:-9])
    code, said = evaluate(damaged)
    assert code == 2 and said.count("\n") == 1 and damaged.name in said
    shutil.copy(sorted((run / "checkpoints").glob("*.pt"))[0], tmp_path / "alone.pt")
    code, said = evaluate(tmp_path / "alone.pt")
    assert code == 2 and "is not a run's folder: it has no config.json" in said
