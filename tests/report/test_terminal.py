"""The state of runs in characters, without disturbing them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.cli import watch as terminal
from proposer_rl.cli.watch import BLOCKS, duration, find_progress, main, read_progress, sparkline
from tests.report.folders import TASK, write_run


def listing(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_size) for path in folder.rglob("*")}


def watch(capsys, *arguments: str) -> str:
    main([*arguments, "--once"])
    return capsys.readouterr().out


def test_one_run_is_a_row_with_its_curve(tmp_path: Path, capsys) -> None:
    folder = write_run(tmp_path / "run", "perf_gain", [7])
    before = listing(tmp_path)
    text = watch(capsys, str(folder))
    assert listing(tmp_path) == before
    (row,) = [line for line in text.splitlines() if line.startswith("run ") and "state" not in line]
    assert "finished" in row and "20/20" in row and "ID success 0.900" in row
    assert set(row) & set(BLOCKS[1:]) and "1 run: 1 finished" in text


def test_seeds_of_which_one_is_a_row_ahead_are_drawn(tmp_path: Path, capsys) -> None:
    folder = write_run(tmp_path / "run", seeds=[0, 1], finished=False)
    table = folder / "metrics.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-1]))
    assert "ID success 0.500" in watch(capsys, str(folder))


def test_several_runs_are_a_table(tmp_path: Path, capsys) -> None:
    write_run(tmp_path / "done")
    write_run(tmp_path / "going", finished=False)
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "config.json").write_text("{}")
    (tmp_path / "broken").mkdir()
    failure = {"message": "no such [level]\x1b", "kind": "E", "exit_code": 2}
    (tmp_path / "broken" / "error.json").write_text(json.dumps(failure))
    states = {p.folder.name: p.state for p in find_progress(tmp_path)}
    expected = {"done": "finished", "going": "unfinished", "begun": "starting", "broken": "failed"}
    assert states == expected
    text = watch(capsys, str(tmp_path))
    assert "failed: broken: no such [level]?" in text
    assert "4 runs: 1 finished, 1 failed, 1 unfinished, 1 starting" in text


def test_an_unreadable_run_is_said_to_have_failed(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    (folder / "metrics.csv").write_text("a,b\n1,x\n")
    progress = read_progress(folder)
    assert progress.state == "failed" and "could not convert" in progress.failure


def test_the_age_is_that_of_the_newest_file(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    for path in folder.iterdir():
        os.utime(path, (1_000_000, 1_000_000))
    old = read_progress(folder).age
    (folder / "metrics.csv").touch()
    assert old > 1e8 and read_progress(folder).age < 60


def test_a_file_that_gets_its_name_meanwhile_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, listed = write_run(tmp_path / "run"), os.scandir
    temporary = folder / ".summary.json.tmp"

    def renamed_after(path: Path) -> Iterator[os.DirEntry[str]]:
        temporary.write_text("{}")
        found = list(listed(path))
        os.replace(temporary, folder / "summary.json")
        return iter(found)

    monkeypatch.setattr(terminal.os, "scandir", renamed_after)
    assert 0 <= read_progress(folder).age < 60


@pytest.mark.parametrize("arguments", [["missing"], ["."]])
def test_wrong_folders_get_one_line(arguments, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")


@given(st.lists(st.floats(-2, 3), max_size=20))
def test_a_sparkline_rises_with_its_values(values: list[float]) -> None:
    drawn = sparkline(sorted(values), 0, 1)
    heights = [BLOCKS.index(block) for block in drawn]
    assert len(drawn) == len(values) and heights == sorted(heights)
    assert sparkline([0, 1, -5, 5, 0.5], 0, 1) == " █ █▄"


def test_names_are_no_markup_and_steer_no_terminal(tmp_path: Path, capsys) -> None:
    task = {**TASK, "distributions": ["[/red]"]}
    schedule = {"headline": "[/red]_success", "threshold": 0.8}
    write_run(tmp_path / "[x]", "[/x]", task=task, schedule=schedule)
    write_run(tmp_path / "b\x1b[2J")
    text = watch(capsys, str(tmp_path))
    assert "[x]" in text and "[/red] success" in text and "\x1b" not in text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (119, "119 s"), (120, "2 min"), (7199, "120 min"), (18_000, "5 h"), (2e5, "2 d")],
)
def test_durations_are_in_the_unit_that_reads_best(seconds: float, text: str) -> None:
    assert duration(seconds) == text
