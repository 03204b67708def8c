"""Published runs: small, of no machine, and read as the runs that they were copied from."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from proposer_rl.cli.report import main
from proposer_rl.report.curves import learning_curves
from proposer_rl.report.reading import begun, find_runs
from proposer_rl.report.studies import read_studies
from proposer_rl.runs.folder import write_atomically
from tests.report.folders import LEVEL, cycle, write_run

SECRET = "/home/somebody/code"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Five seeds of two methods, with pictures wherever there can be any."""
    told = {"levels": {"the best": [LEVEL] * 2}}
    cycles = [{**cycle(i, [0.1, 0.2], [[8 - i, 1, 1], [1, 1, 1 + i]]), **told} for i in range(2)]
    curves = {"perf_gain": [0.0, 0.8, 0.9], "target": [0.0, 0.3, 0.6]}
    arguments = {"config_dir": f"{SECRET}/conf", "pythonpath": SECRET}
    reused = f"{SECRET}/runs/5/checkpoints"
    for method, curve in curves.items():
        for seed in range(5):
            write_run(
                tmp_path / "runs" / f"{method}_{seed}",
                method,
                [seed],
                [value - 0.01 * seed for value in curve],
                cycles=cycles if method == "perf_gain" else (),
                levels=[0.1 * seed, *curve[1:]],
                facts={"arguments": arguments, "overrides": [f"checkpoint={reused}"]},
                checkpoint=reused,
            )
    return tmp_path / "runs"


def published(runs: Path, output: Path) -> Path:
    main([str(runs), "--publish", str(output)])
    return output


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_tables_of_the_copies_are_those_of_the_runs(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("proposer_rl.report.build.DRAWINGS", [learning_curves])
    light = published(runs, tmp_path / "light")
    tables = {}
    for name, folder in {"before": runs, "after": light}.items():
        main([str(folder), "-o", str(tmp_path / name), "-q"])
        tables[name] = contents(tmp_path / name / "tables") | contents(tmp_path / name / "figures")
    assert {"levels.csv", "cycles.csv", "metrics.csv"} < tables["before"].keys()
    assert tables["after"] == tables["before"]


def test_a_copy_has_no_pictures_and_names_no_folder_of_the_machine(
    runs: Path, tmp_path: Path
) -> None:
    found = contents(published(runs, tmp_path / "light"))
    everything = b"".join(found.values()).decode()
    assert SECRET not in everything and "somebody" not in everything
    assert str(LEVEL["picture"]) not in everything
    assert not any("curriculum.jsonl" in name or "checkpoint" in name for name in found)
    config = json.loads(found["target_0/config.json"])
    assert config["checkpoint"] == "5/checkpoints"
    for name in ("run.json", "summary.json"):
        facts = json.loads(found[f"target_0/{name}"])
        assert facts["overrides"] == ["checkpoint=5/checkpoints"]
        assert facts["arguments"] == {"config_dir": "conf", "pythonpath": "code"}


def test_runs_of_other_checkpoints_are_published(tmp_path: Path) -> None:
    for life in range(3):
        given = f"{tmp_path}/lives/{life}/lifetime_2"
        own = {"checkpoint": given, "curriculum": {"_target_": "some.factory", "checkpoint": given}}
        write_run(tmp_path / "runs" / str(life), "frozen_proposer", [5 + life], **own)
    for folder in (tmp_path / "runs", published(tmp_path / "runs", tmp_path / "light")):
        (study,), notes = read_studies(find_runs([folder]), None)
        assert len(study.groups) == 1 and len(study.runs) == 3 and not notes
    config = json.loads((tmp_path / "light" / "1" / "config.json").read_text())
    assert config["checkpoint"] == config["curriculum"]["checkpoint"] == "1/lifetime_2"


def test_proposers_of_several_lifetimes_come_along(tmp_path: Path) -> None:
    for name, lifetimes in {"alone": 1, "0/lifetime_1": 2}.items():
        folder = write_run(tmp_path / "runs" / name, lifetimes=lifetimes)
        (folder / "proposer.pt").write_bytes(name.encode())
    light = published(tmp_path / "runs", tmp_path / "light")
    found = {name: content for name, content in contents(light).items() if "proposer" in name}
    assert found == {"0/lifetime_1/proposer.pt": b"0/lifetime_1"}
    assert contents(published(light, light)) == contents(light)


def test_returns_of_single_levels_are_kept_where_there_is_no_success(tmp_path: Path) -> None:
    rows = {"a": {"success": [0.5], "return": [0.4]}, "b": {"return": [0.4]}}
    for name, row in rows.items():
        folder = write_run(tmp_path / "runs" / name)
        head = {"seed": 0, "updates": 20, "distribution": "id"}
        (folder / "levels.jsonl").write_text(json.dumps({**head, **row}) + "\n")
    found = contents(published(tmp_path / "runs", tmp_path / "light"))
    kept = [json.loads(found[f"{name}/levels.jsonl"]) for name in rows]
    assert [set(row) - {"seed", "updates", "distribution"} for row in kept] == [
        {"success"},
        {"return"},
    ]


def test_published_runs_are_added_to_and_replaced(runs: Path, tmp_path: Path) -> None:
    light = published(runs, tmp_path / "light")
    before = contents(light)
    assert contents(published(light, light)) == before  # of themselves nothing changes
    shutil.rmtree(runs)
    write_run(runs / "target_0", "target", [0], [0.0, 0.1])
    write_run(runs / "new", "plr", [0])
    after = contents(published(runs, light))
    assert {name.partition("/")[0] for name in after} == {
        *(name.partition("/")[0] for name in before),
        "new",
    }
    changed = {name.partition("/")[0] for name in before if after.get(name) != before[name]}
    assert changed == {"target_0"}
    assert "target_0/levels.jsonl" not in after  # nothing of the former run is left


@pytest.mark.parametrize("done", [1, 5])
def test_a_copy_that_was_broken_off_is_no_run_and_made_again(
    done: int, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []

    def interrupted(path: Path, content: bytes) -> None:
        if len(written) == done:
            raise KeyboardInterrupt
        written.append(path)
        write_atomically(path, content)

    light = tmp_path / "light"
    with monkeypatch.context() as patch:
        patch.setattr("proposer_rl.report.publish.write_atomically", interrupted)
        with pytest.raises(SystemExit):
            main([str(runs), "--publish", str(light)])
    assert written[0].parent.is_dir() and not list(begun(light))
    published(runs, light)
    assert len(find_runs([light])) == 10 and not list(light.glob(".*"))


def test_runs_lie_as_they_did_below_the_folder_that_was_named(tmp_path: Path) -> None:
    """Solvers of several lifetimes have folders of the same names; a lone run keeps its own."""
    for seed in range(2):
        write_run(tmp_path / "lives" / str(seed) / "lifetime_0", seeds=[seed])
    light = published(tmp_path / "lives", tmp_path / "light")
    published(write_run(tmp_path / "alone"), light)
    places = {str(path.parent.relative_to(light)) for path in light.rglob("config.json")}
    assert places == {"0/lifetime_0", "1/lifetime_0", "alone"}
    assert contents(published(light, light)) == contents(light)


def test_a_run_that_goes_on_is_left_out_and_named(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(runs / "short", "plr", [0], finished=False)
    light = published(runs, tmp_path / "light")
    assert "left out: short: not finished" in capsys.readouterr().out
    assert not (light / "short").exists() and (light / "target_0").is_dir()


def test_what_cannot_be_published_is_one_line_and_changes_nothing(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other"
    write_run(other / "target_0", "target", [7])
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("mine")
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SystemExit) as end:
        main([str(runs), "--publish", "new", "--threshold", "0.5"])
    assert end.value.code == 2 and "--publish: copies runs" in capsys.readouterr().err
    deep = tmp_path / "deep"
    write_run(deep / "target_0", "target", [7])
    (deep / "target_0" / "checkpoints").mkdir()
    wrong = {
        "has curriculum.jsonl, so it is no copy": [str(runs), str(runs)],
        "has checkpoints, so it is no copy": [str(runs), str(deep)],
        "--publish: two runs are called target_0: ": [str(runs), str(other), "new"],
        "has thesis.tex in it, which is no run": [str(runs), str(tmp_path / "mine")],
        "is a file; give a folder": [str(runs), str(tmp_path / "file")],
    }
    for message, (*folders, output) in wrong.items():
        before = contents(tmp_path)
        with pytest.raises(SystemExit) as end:
            main([*folders, "--publish", str(output)])
        assert end.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ") and message in line
        assert contents(tmp_path) == before and not Path("new").exists()
