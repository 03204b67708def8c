"""Published runs: a few tables, of no machine, and read as the runs that they were made from."""

from __future__ import annotations

import csv
import io
import json
import lzma
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from proposer_rl.cli.report import main as report
from proposer_rl.report import publish
from proposer_rl.report.figures import learning_curves
from proposer_rl.report.reading import find_runs, read_run
from proposer_rl.report.runs import tables
from proposer_rl.report.studies import read_studies
from tests.report.folders import LEVEL, cycle, write_run

SECRET = "/home/somebody/code"


@pytest.fixture(autouse=True)
def without_figures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "pictures" not in request.keywords:
        monkeypatch.setattr(publish, "write_page", lambda *_: None)


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Five seeds of two methods, with pictures wherever there can be any."""
    cycles = [cycle(i, [0.1, 0.2], [[8 - i, 1, 1], [1, 1, 1 + i]]) for i in range(2)]
    curves = {"perf_gain": [0.0, 0.8, 0.9], "target": [0.0, 0.3, 0.6]}
    arguments = {"config_dir": f"{SECRET}/conf", "pythonpath": SECRET}
    reused = f"{SECRET}/runs/5/checkpoints"
    for method, curve in curves.items():
        for seed in range(5):
            write_run(
                tmp_path / "runs" / f"{method}_{seed}",
                method,
                [seed],
                [round(value - 0.01 * seed, 2) for value in curve],
                cycles=cycles if method == "perf_gain" else (),
                levels=[seed / 10, *curve[1:]],
                facts={"arguments": arguments, "overrides": [f"checkpoint={reused}"]},
                checkpoint=reused,
            )
    return tmp_path / "runs"


def published(runs: Path, output: Path) -> Path:
    report([str(runs), "--publish", str(output)])
    return output


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def rows(study: Path, table: str) -> list[dict[str, str]]:
    text = lzma.decompress((study / f"{table}.csv.xz").read_bytes()).decode()
    return list(csv.DictReader(io.StringIO(text)))


def test_tables_of_the_study_are_those_of_the_runs(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("proposer_rl.report.build.DRAWINGS", [learning_curves])
    write_run(runs / "together", "plr", [3, 4], levels=[0.5], copies=2)
    light = published(runs, tmp_path / "light")
    tables = {}
    for name, folder in {"before": runs, "after": light}.items():
        report([str(folder), "-o", str(tmp_path / name)])
        tables[name] = contents(tmp_path / name / "tables") | contents(tmp_path / name / "figures")
    assert {"levels.csv", "cycles.csv", "metrics.csv"} < tables["before"].keys()
    assert tables["after"] == tables["before"]


@pytest.mark.slow
@pytest.mark.pictures
def test_a_study_has_a_page_with_its_figures(runs: Path, tmp_path: Path) -> None:
    """What its authors wrote above the mark stays."""
    light = published(runs, tmp_path / "light")
    assert {path.name for path in light.iterdir()} == {
        "README.md", "figures", *(f"{name}.csv.xz" for name in ("runs", "metrics", "training",
                                                                "cycles", "levels")),
    }  # fmt: skip
    page = (light / "README.md").read_text(encoding="utf-8")
    assert "| perf\\_gain | 5 |" in page and "| worse, p" in page
    for name in ("learning_curves", "proposals"):
        assert f"(figures/{name}.png)" in page and (light / f"figures/{name}.png").is_file()
    above, mark, below = page.partition(publish.MARK)
    (light / "README.md").write_text(f"# Mine\n{mark}old", encoding="utf-8")
    publish.write_page(light)
    again = (light / "README.md").read_text(encoding="utf-8")
    assert again == f"# Mine\n\n{mark}{below}" and "pandas.read_csv" in above


def test_a_study_has_no_pictures_and_names_no_folder_of_the_machine(
    runs: Path, tmp_path: Path
) -> None:
    light = published(runs, tmp_path / "light")
    everything = b"".join(lzma.decompress(file.read_bytes()) for file in light.iterdir()).decode()
    assert SECRET not in everything and "somebody" not in everything
    assert str(LEVEL["picture"]) not in everything
    first = rows(light, "runs")[0]
    assert json.loads(first["config"])["checkpoint"] == "5/checkpoints"
    facts = json.loads(first["facts"])
    assert facts["overrides"] == ["checkpoint=5/checkpoints"]
    assert facts["arguments"] == {"config_dir": "conf", "pythonpath": "code"}


def test_a_path_inside_the_working_folder_stays_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = f"{tmp_path}/results/medium/proposer.pt"
    facts = {"overrides": ["+method=frozen_proposer", f"checkpoint={given}", "seed=0"]}
    write_run(tmp_path / "runs" / "a", "frozen_proposer", [0], facts=facts, checkpoint=given)
    (run,) = read_run(published(tmp_path / "runs", tmp_path / "results" / "light"))
    assert run.config["checkpoint"] == "results/medium/proposer.pt"
    assert run.facts["overrides"][1] == "checkpoint=results/medium/proposer.pt"


def test_runs_of_other_checkpoints_are_published(tmp_path: Path) -> None:
    for life in range(3):
        given = f"{tmp_path}/lives/{life}/lifetime_2"
        own = {"checkpoint": given, "curriculum": {"_target_": "some.factory", "checkpoint": given}}
        write_run(tmp_path / "runs" / str(life), "frozen_proposer", [5 + life], **own)
    for folder in (tmp_path / "runs", published(tmp_path / "runs", tmp_path / "light")):
        (study,), notes = read_studies(find_runs([folder]), None)
        assert len(study.groups) == 1 and len(study.runs) == 3 and not notes
    config = study.runs[1].config
    assert config["checkpoint"] == config["curriculum"]["checkpoint"] == "1/lifetime_2"


def test_returns_of_single_levels_are_kept_where_they_are_shown(tmp_path: Path) -> None:
    both = {"success": [0.5], "return": [0.4]}
    schedule = {"headline": "id_return", "threshold": 1, "cycle_length": 20}
    write_run(tmp_path / "runs" / "c", "plr", schedule=schedule)
    for name, row in {"a": both, "b": {"return": [0.4]}, "c": both}.items():
        folder = tmp_path / "runs" / name
        if name != "c":
            write_run(folder)
        head = {"seed": 0, "updates": 20, "distribution": "id"}
        (folder / "levels.jsonl").write_text(json.dumps({**head, **row}) + "\n")
    light = published(tmp_path / "runs", tmp_path / "light")
    found = [(row["run"], row["success"], row["return"]) for row in rows(light, "levels")]
    assert found == [("a", "0.5", ""), ("b", "", "0.4"), ("c", "0.5", "0.4")]


def test_a_cycle_that_logs_a_number_called_run_stays_its_runs(tmp_path: Path) -> None:
    cycles = [{"updates": 0, "score": 1, "run": 7, "method": 8}, {"updates": 20, "score": 2}]
    write_run(tmp_path / "runs" / "a", "plr", [0], cycles=cycles)
    light = published(tmp_path / "runs", tmp_path / "light")
    (run,) = read_run(light)
    assert [cycle["score"] for cycle in run.cycles] == [1, 2]
    told = tables([("plr", replace(run, cycles=[*cycles, {"updates": 0, "seed": 3}]))], "method")
    assert told["cycles"]["method"].tolist() == ["plr"] * 3
    assert [int(seed) for seed in told["cycles"]["seed"]] == [0, 0, 3]  # its own, where it has one


def test_fractions_have_six_digits_and_counts_all_of_theirs(tmp_path: Path) -> None:
    long = 1_234_567.1234567
    reached, cell = [0.0, 1 / 3, 1e-5 / 3], {"performance": [[1 / 3, long]], "updates": 12_345_678}
    write_run(tmp_path / "runs" / "a", "plr", [0], reached, cycles=[cell], levels=reached)
    light = published(tmp_path / "runs", tmp_path / "light")
    expected = ["0", "0.333333", "3.33333e-06"]
    assert [row["id_success"] for row in rows(light, "metrics")] == expected
    assert [row["success"] for row in rows(light, "levels")] == 2 * expected
    (found,) = rows(light, "cycles")
    assert json.loads(found["performance"]) == [[0.333333, 1_234_570.0]]
    assert json.loads(found["updates"]) == 12_345_678


def test_a_study_is_added_to_and_its_runs_are_replaced(runs: Path, tmp_path: Path) -> None:
    light = published(runs, tmp_path / "light")
    before = {(run.folder.name, run.updates) for run in read_run(light)}
    shutil.rmtree(runs)
    write_run(runs / "target_0", "target", [0], [0.0, 0.1])
    write_run(runs / "new", "plr", [0])
    after = {(run.folder.name, run.updates) for run in read_run(published(runs, light))}
    assert after - before == {("target_0", 10), ("new", 20)}
    assert before - after == {("target_0", 20)}
    assert not [row for row in rows(light, "levels") if row["run"] == "target_0"]


def test_runs_are_called_as_they_lie_below_the_folder_that_was_named(tmp_path: Path) -> None:
    """Solvers of several lifetimes have folders of the same names; a lone run keeps its own."""
    for seed in range(2):
        write_run(tmp_path / "lives" / str(seed) / "lifetime_0", seeds=[seed])
    light = published(tmp_path / "lives", tmp_path / "light")
    published(write_run(tmp_path / "alone"), light)
    names = {str(run.folder.relative_to(light)) for run in read_run(light)}
    assert names == {"0/lifetime_0", "1/lifetime_0", "alone"}


def test_a_run_that_goes_on_is_left_out_and_named(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(runs / "short", "plr", [0], finished=False)
    light = published(runs, tmp_path / "light")
    assert "left out: short: not finished" in capsys.readouterr().out
    assert {row["method"] for row in rows(light, "runs")} == {"perf_gain", "target"}


def test_what_cannot_be_published_is_one_line_and_changes_nothing(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(tmp_path / "other" / "target_0", "target", [7])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    (tmp_path / "file").write_text("mine")
    wrong = {
        "runs: is not empty, and has no runs.csv.xz; use a new directory": [runs, runs],
        "two runs have the name target_0: ": [runs, tmp_path / "other", "new"],
        "mine: is not empty": [runs, tmp_path / "mine"],
        "file: Not a directory": [runs, tmp_path / "file"],
    }
    for message, (*folders, output) in wrong.items():
        before = contents(tmp_path)
        with pytest.raises(SystemExit) as end:
            report([*map(str, folders), "--publish", str(output)])
        assert end.value.code == (4 if "file: " in message else 2)
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ") and message in line
        assert contents(tmp_path) == before and not Path("new").exists()
