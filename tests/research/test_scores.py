"""``bin/research scores`` on a run of a few updates: each run on each set once."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch.utils._pytree import tree_leaves

from proposer_rl.cli.eval import load
from proposer_rl.cli.eval import main as evaluate
from proposer_rl.runs.checkpoint import load_latest, save_checkpoint
from research.scores import main
from tests.commands import call


@pytest.fixture
def scores_of(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Calls the command; returns its exit code and what it said."""

    def call_it(*arguments: object) -> tuple[int, str]:
        code = call(main, *map(str, arguments))
        said = capsys.readouterr()
        return code, said.err if code else said.out

    return call_it


@pytest.mark.slow
def test_several_runs_are_compared_by_their_means(
    scores_of, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each on each set once, however often the command is given."""
    rows: dict[str, list[dict]] = {}
    for name in ("small", "id@7x9"):
        evaluate([str(run), "--levels", name, "-o", str(tmp_path / "rows.json")])
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
    code, said = scores_of(tmp_path / "runs", "--levels", "small", "-o", output)
    assert code == 0 and "target" in said and "of_older_code" in said
    before = output.read_text()
    code, said = scores_of(tmp_path / "runs", "--levels", "nope", "-o", tmp_path / "nope.csv")
    assert code == 2 and "--levels nope: must be one of" in said
    both = [tmp_path / "runs", "--levels", "small", "id@7x9", "-o", output]
    assert scores_of(*both)[0] == 0 and output.read_text().startswith(before)
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
    monkeypatch.setattr("research.scores.load", None)  # nothing is left to be done
    assert scores_of(*both)[0] == 0


def test_what_has_changed_is_evaluated_anew(scores_of, run: Path, tmp_path: Path) -> None:
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
        assert scores_of(*command)[0] == 0
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
    scores_of, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second begins and ends while the first, which has read the table, is at its first run."""
    folders = [named(run, tmp_path / "one", "a", "b"), named(run, tmp_path / "two", "c", "d")]
    output = tmp_path / "scores.csv"

    def command(folder: Path) -> list[object]:
        return [folder, "--levels", "small", "-o", output]

    def meanwhile(checkpoint: Path) -> object:
        monkeypatch.setattr("research.scores.load", load)
        assert scores_of(*command(folders[1]))[0] == 0
        return load(checkpoint)

    monkeypatch.setattr("research.scores.load", meanwhile)
    assert scores_of(*command(folders[0]))[0] == 0
    with output.open() as file:
        found = [(row["run"], row["seed"]) for row in csv.DictReader(file)]
    assert sorted(found) == [(name, seed) for name in "abcd" for seed in "35"]
    before = output.read_bytes()
    monkeypatch.setattr("research.scores.load", None)  # nothing is left to be done
    assert scores_of(tmp_path, "--levels", "small", "-o", output)[0] == 0
    assert output.read_bytes() == before


def test_runs_that_are_not_finished_are_left_out_and_named(
    scores_of, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, output = named(run, tmp_path / "runs", "done", "going"), tmp_path / "scores.csv"
    (folder / "going" / "summary.json").unlink()
    main([*map(str, folder.iterdir()), "--levels", "small", "-o", str(output)])
    said = capsys.readouterr()
    assert said.err.splitlines() == ["left out: going: not finished"]
    with output.open() as file:
        assert {row["run"] for row in csv.DictReader(file)} == {"done"}
    going, other = folder / "going", tmp_path / "other.csv"
    code, said = scores_of(going, "--levels", "small", "-o", other)
    assert code == 2 and f"{going}: no run is finished" in said and len(said.splitlines()) == 1
    assert not other.exists()


def test_another_table_is_not_written_over(run: Path, tmp_path: Path, scores_of) -> None:
    (table := tmp_path / "table.csv").write_text("run,seed\na,1\n")
    code, said = scores_of(run, "--levels", "id", "-o", table)
    assert code == 2 and "holds no scores of runs" in said
    assert table.read_text() == "run,seed\na,1\n"
