"""``bin/eval`` as users call it, on a run of a few updates."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch.utils._pytree import tree_leaves

from proposer_rl.cli.eval import main
from proposer_rl.cli.evaluate import SHOWN, load
from proposer_rl.runs.checkpoint import load_latest, save_checkpoint
from proposer_rl.runs.folder import read_csv, read_jsonl
from proposer_rl.tasks.mazes.level_files import shipped_levels
from tests.commands import trained_run

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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two Solvers that were trained side by side."""
    settings = ["compute.progress=false", "seeds=[3,5]", "task.evaluation.levels=40"]
    folder = tmp_path_factory.mktemp("runs") / "trained"
    return trained_run(folder, "+method=target", "+scale=smoke", *settings)


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


def test_the_set_that_comes_along(run: Path, tmp_path: Path, evaluate) -> None:
    files = {name: tmp_path / name for name in ("rows.csv", "rows.json", "sheet.png")}
    first = evaluate(run, "-o", files["rows.csv"], "--pictures", files["sheet.png"])
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
    levels = shipped_levels("shapes")
    assert [row["level"] for row in rows[::2]] == list(levels)
    for row in rows:
        assert row["max_steps"] == max(10, 2 * row["path_length"])
        assert (row["height"], row["width"]) == tuple(levels[row["level"]].walls.shape)
    assert files["sheet.png"].read_bytes().startswith(b"\x89PNG")
    assert files["sheet.png"].stat().st_size > 10_000


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
        assert {row["level"] for row in csv.DictReader(file)} == {"'=1+1"}  # no formula


def test_one_checkpoint_of_a_run(run: Path, tmp_path: Path, evaluate) -> None:
    file = sorted((run / "checkpoints").glob("*.pt"))[0]
    assert evaluate(file, "-o", tmp_path / "rows.json")[0] == 0
    assert json.loads((tmp_path / "rows.json").read_text())[0]["updates"] == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: there is no such file or folder"),
        (["."], ".: holds no checkpoints; give a run's folder or a checkpoint"),
        (["{run}/metrics.csv"], "is no run's folder: it has no config.json"),
        (
            ["{run}", "--levels", "mazes"],
            "--levels mazes: must be one of: shapes, small, a file ",
        ),
        (["{run}", "--levels", "none.txt"], "--levels none.txt: there is no such file"),
        (["{run}", "--levels", "bad.json"], "bad.json: is no JSON"),
        (["{run}", "--levels", "small.txt"], "level 'small': its 3x5 cells are halved to nothing"),
        (["{run}", "-o", "rows.txt"], "--output rows.txt: must end in .json or .csv"),
        (["{run}", "-o", "no/rows.csv"], "--output no/rows.csv: there is no folder no"),
        (["{run}", "--pictures", "a.jpg"], "--pictures a.jpg: must end in .png"),
        (["{run}", "--max-steps", "0"], "must be a whole number from 1 to 100,000, got '0'"),
        (["{run}", "--max-steps", "100001"], "from 1 to 100,000, got '100001'"),
        (["{run}", "--max-steps", "many"], "must be a whole number from 1 to"),
    ],
)
def test_bad_input_is_told_in_one_line(
    arguments: list[str], message: str, run: Path, tmp_path: Path, evaluate, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bad.json").write_text("{")
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
    for solver in ({}, {**state["solver"], "more": state["solver"]}, 3):
        save_checkpoint(checkpoints, step, {**state, "solver": solver})
        code, said = evaluate(tmp_path / "run")
        assert code == 2 and "holds no Solver with the network of its run's" in said
    damaged = next(checkpoints.glob("*.pt"))
    damaged.write_bytes(damaged.read_bytes()[:-9])
    code, said = evaluate(damaged)
    assert code == 2 and said.count("\n") == 1 and damaged.name in said
    shutil.copy(sorted((run / "checkpoints").glob("*.pt"))[0], tmp_path / "alone.pt")
    code, said = evaluate(tmp_path / "alone.pt")
    assert code == 2 and "is no run's folder: it has no config.json" in said


def test_several_runs_are_compared_by_their_means(
    evaluate, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each on each set once, however often the command is given."""
    rows: dict[str, list[dict]] = {}
    for name in ("small", "id@7x9"):
        assert evaluate(run, "--levels", name, "-o", tmp_path / "rows.json")[0] == 0
        rows[name] = json.loads((tmp_path / "rows.json").read_text())
    grids = {(row["height"], row["width"], row["path_length"]) for row in rows["id@7x9"]}
    assert grids == {(7, 9, 4)} and len(rows["id@7x9"]) == 2 * 40  # the target's specification
    output = tmp_path / "scores.csv"
    called = "+method=target"  # as Hydra can call a folder; in the table no formula
    shutil.copytree(run, tmp_path / "runs" / called)
    shutil.copytree(run, tmp_path / "runs" / "unreadable")
    settings = json.loads((run / "config.json").read_text())
    settings |= {"method": "of_older_code", "pool": None}
    (tmp_path / "runs" / "unreadable" / "config.json").write_text(json.dumps(settings))
    code, said = evaluate(tmp_path / "runs", "--levels", "small", "-o", output)
    assert code == 0 and "target" in said and "of_older_code" in said
    before = output.read_text()
    limited = ("--levels", "small", "--max-steps", 5, "-o", tmp_path / "limited.csv")
    code, said = evaluate(tmp_path / "runs", *limited)
    assert code == 2 and "--max-steps: --output" in said
    code, said = evaluate(tmp_path / "runs", "--levels", "nope", "-o", tmp_path / "nope.csv")
    assert code == 2 and "--levels nope: must be one of" in said
    both = [tmp_path / "runs", "--levels", "small", "id@7x9", "-o", output]
    assert evaluate(*both)[0] == 0 and output.read_text().startswith(before)
    with output.open() as file:
        scores = list(csv.DictReader(file))
    assert {row["run"] for row in scores} == {f"'{called}"} and len(scores) == 4
    for score in scores:
        own = [row for row in rows[score["levels"]] if row["seed"] == int(score["seed"])]
        assert int(score["size"]) == len(own)
        for key, name in (("success", "success"), ("returns", "return")):
            mean = sum(row[name] for row in own) / len(own)
            assert float(score[key]) == pytest.approx(mean, rel=1e-5)
    shutil.rmtree(tmp_path / "runs" / "unreadable")
    monkeypatch.setattr("proposer_rl.cli.compare.load", None)  # nothing is left to be done
    assert evaluate(*both)[0] == 0


def test_what_has_changed_is_evaluated_anew(evaluate, run: Path, tmp_path: Path) -> None:
    """Runs of the same name that were replaced, and files of levels that were rewritten."""
    (deep := tmp_path / ("n" * 100)).mkdir()
    levels, output = deep / "levels.txt", tmp_path / "scores.csv"
    shutil.copytree(run, tmp_path / "runs" / "kept")
    shutil.copytree(run, replaced := tmp_path / "runs" / "replaced")
    settings = json.loads((run / "config.json").read_text()) | {"method": "another"}
    (replaced / "config.json").write_text(json.dumps(settings))
    levels.write_text("[near]\nSG....\n......\n......\n......\n")
    command = [tmp_path / "runs", "--levels", levels, "small", "-o", output]

    def scores() -> dict[tuple[str, str, str], dict]:
        assert evaluate(*command)[0] == 0
        with output.open() as file:
            rows = list(csv.DictReader(file))
        found = {(row["run"], row["seed"], row["levels"]): row for row in rows}
        assert len(found) == len(rows) == 2 * 2 * 2
        return found

    first = scores()
    updates, values = load_latest(replaced / "checkpoints")
    for tensor in tree_leaves(values["solver"]):
        if isinstance(tensor, torch.Tensor):
            tensor.zero_()
    save_checkpoint(replaced / "checkpoints", updates, values)
    second = scores()
    changed = {place for place, row in second.items() if row != first[place]}
    assert changed == {place for place in first if place[0] == "replaced"}
    levels.write_text("[far]\nS.....\n......\n......\n.....G\n")
    third = scores()
    changed = {place for place, row in third.items() if row != second[place]}
    assert changed == {place for place in first if place[2] == str(levels)}


def named(run: Path, folder: Path, *names: str) -> Path:
    """A folder with copies of a run under other names, each a method of its own."""
    for name in names:
        shutil.copytree(run, folder / name)
        settings = json.loads((run / "config.json").read_text()) | {"method": name}
        (folder / name / "config.json").write_text(json.dumps(settings))
    return folder


def test_two_commands_may_add_to_one_table(
    evaluate, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second begins and ends while the first, which has read the table, is at its first run."""
    folders = [named(run, tmp_path / "one", "a", "b"), named(run, tmp_path / "two", "c", "d")]
    output = tmp_path / "scores.csv"

    def command(folder: Path) -> list[object]:
        return [folder, "--levels", "small", "-o", output]

    def meanwhile(checkpoint: Path) -> object:
        monkeypatch.setattr("proposer_rl.cli.compare.load", load)
        assert evaluate(*command(folders[1]))[0] == 0
        return load(checkpoint)

    monkeypatch.setattr("proposer_rl.cli.compare.load", meanwhile)
    assert evaluate(*command(folders[0]))[0] == 0
    with output.open() as file:
        found = [(row["run"], row["seed"]) for row in csv.DictReader(file)]
    assert sorted(found) == [(name, seed) for name in "abcd" for seed in "35"]
    before = output.read_bytes()
    monkeypatch.setattr("proposer_rl.cli.compare.load", None)  # nothing is left to be done
    assert evaluate(tmp_path, "--levels", "small", "-o", output)[0] == 0
    assert output.read_bytes() == before


def test_runs_that_are_not_finished_are_left_out_and_named(
    evaluate, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, output = named(run, tmp_path / "runs", "done", "going"), tmp_path / "scores.csv"
    (folder / "going" / "summary.json").unlink()
    main([*map(str, folder.iterdir()), "--levels", "small", "-o", str(output)])
    said = capsys.readouterr()
    assert said.err.splitlines() == ["left out: going: not finished"]
    with output.open() as file:
        assert {row["run"] for row in csv.DictReader(file)} == {"done"}
    going, other = folder / "going", tmp_path / "other.csv"
    for arguments in ([going, going, "--levels", "small"], [going, "--levels", "small", "id"]):
        code, said = evaluate(*arguments, "-o", other)
        assert code == 2 and f"{going}: no run is finished" in said and len(said.splitlines()) == 1
    assert not other.exists()
    assert evaluate(going, "--levels", "small")[0] == 0  # one on one set, as it is by now


def test_scores_of_several_runs_are_not_written_over(evaluate, run: Path, tmp_path: Path) -> None:
    output = tmp_path / "scores.csv"
    assert evaluate(run, run, "--levels", "small", "-o", output)[0] == 0
    before = output.read_bytes()
    code, said = evaluate(run, "--levels", "small", "-o", output)
    assert code == 2 and "has scores of several runs" in said
    assert output.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{run}", "{run}"], "--levels: name the sets"),
        (["{run}", "--levels", "small", f"{'x' * 1024}.txt"], "at most 1024 printable"),
        (["{run}", "--levels", "small", "two\nlines.txt"], "takes names of one line"),
        (["{run}", "--levels", "small", "shapes", "--pictures", "x.png"], "--pictures: give one"),
        (["{run}", "--levels", "small", "shapes", "-o", "x.json"], "are written as .csv"),
        (["{run}", "{run}", "--levels", "nothing"], "must be one of: "),
        (["{run}", "--levels", "id@1x2"], "--levels id@1x2: "),
        (
            ["{file}", "--levels", "id", "ood"],
            ".pt: is a file; several runs or sets of levels take",
        ),
        (["{run}", "{file}", "--levels", "id"], ".pt: is a file; several runs or sets of levels"),
        (["{run}", "nowhere", "--levels", "id"], "nowhere: there is no such folder"),
        (["{run}", "{run}", "--levels", "id", "-o", "{table}"], "holds no scores of runs"),
    ],
)
def test_wrong_comparisons_get_one_line(
    arguments, message, run: Path, tmp_path: Path, evaluate
) -> None:
    (table := tmp_path / "table.csv").write_text("run\n" + "x" * 2**18)  # longer than csv reads
    places = {"run": run, "file": next((run / "checkpoints").glob("*.pt")), "table": table}
    code, said = evaluate(*(word.format(**places) for word in arguments))
    assert code == 2 and said.startswith("error: ") and message in said
    assert len(said.splitlines()) == 1
