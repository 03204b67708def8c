"""Logs of teachers on the page: a curve for each teacher, and what is no log is refused."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import proposer_rl as prl
from proposer_rl.cli.report import main
from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.teachers import drawings, read_curves, read_log
from tests.report.folders import write_jsonl, write_run


def log(file: Path, curriculum: str) -> list[dict]:
    space = prl.Parameters({"<b>gravity": (5.0, 25.0), "ground": ["flat", "stairs"]}, bins=3)
    teacher = prl.Teacher(curriculum, space, block=16)
    rows = []
    for i in range(4):
        ids, _ = teacher.ask(12)
        teacher.tell(ids[:10], torch.arange(10.0) + i, [1] * 10 if i else None)
        rows.append(teacher.log(file))
    return rows


def test_the_page_has_the_entries_of_all_logs_and_what_was_drawn(tmp_path: Path) -> None:
    files = [tmp_path / f"{name}.jsonl" for name in ("plr", "<i>uniform")]
    rows = log(files[0], "plr")
    log(files[1], "domain_randomization")
    found = read_log(files[0])
    assert found.x.tolist() == [10, 20, 30, 40]
    assert found.entries["mean_return"].tolist() == [row["mean_return"] for row in rows]
    assert np.isnan(found.entries["mean_success"][0]) and found.entries["mean_success"][1] == 1
    bins, shares = found.drawn["<b>gravity"]
    assert bins == list(rows[0]["drawn"]["<b>gravity"])
    assert (shares * 12).round().tolist() == [list(r["drawn"]["<b>gravity"].values()) for r in rows]
    assert [len(one.panels) for one in drawings({"plr": found})] == [len(found.entries), 2]
    main([*map(str, files), "-o", str(tmp_path / "page")])
    page = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png') == 3
    assert "&lt;i&gt;uniform" in page and not re.search("<[ib]>", page.partition("<script")[0])
    assert "plr has" not in page  # one teacher, one curve
    assert len([*(tmp_path / "page" / "figures").glob("teachers*.svg")]) == 3


@pytest.mark.usefixtures("undrawn")
def test_logs_stand_on_the_page_of_runs(tmp_path: Path) -> None:
    write_run(tmp_path / "run")
    write_jsonl(tmp_path / "mine.jsonl", [{"told": 4, "drawn": {}, "mean_return": 1}])
    given = [str(tmp_path / name) for name in ("run", "mine.jsonl")]
    main([*given, "-o", str(tmp_path / "page")])
    page = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    assert 'id="study-1"' in page and 'id="teachers"' in page
    text = (tmp_path / "page" / "report.md").read_text(encoding="utf-8")
    assert "(figures/teachers.png)" in text and all(path in text for path in given)


def lines(teacher: str, told: list[int], bins: str = "low") -> list[dict]:
    """Lines of a teacher that has been told 10 levels more in each, up to ``told``."""
    return [
        {"teacher": teacher, "told": 10, "levels_told": x, "drawn": {"a": {bins: 10}}, "score": x}
        for x in told
    ]


@pytest.mark.usefixtures("undrawn")
def test_two_teachers_of_one_file_have_a_curve_each(tmp_path: Path) -> None:
    """As of a script that was run twice (stable-baselines3 #1035), here with other bins."""
    both = [*lines("3f0a", [10, 20, 30]), *lines("77c1", [10, 20], bins="high")]
    write_jsonl(file := tmp_path / "plr.jsonl", both)
    logs, notes = read_curves([file])
    assert {label: log.x.tolist() for label, log in logs.items()} == {
        "plr, teacher 3f0a": [10, 20, 30],
        "plr, teacher 77c1": [10, 20],
    }
    assert [[*log.drawn["a"][0]] for log in logs.values()] == [["low"], ["high"]]
    assert read_log(file).x.tolist() == [10, 20, 30, 10, 20]
    assert len(notes) == 1 and "plr has 2 curves" in notes[0]
    main([str(file), "-o", str(tmp_path / "page")])
    assert notes[0] in (tmp_path / "page" / "report.html").read_text(encoding="utf-8")


def test_lines_of_two_teachers_by_turns_are_no_folds(tmp_path: Path) -> None:
    one, other = lines("a", [10, 20, 30]), lines("b", [10, 20, 30])
    write_jsonl(
        tmp_path / "x.jsonl", [row for pair in zip(one, other, strict=True) for row in pair]
    )
    logs, _ = read_curves([tmp_path / "x.jsonl"])
    assert [log.x.tolist() for log in logs.values()] == [[10, 20, 30]] * 2


def test_a_loop_that_goes_on_from_an_earlier_state_is_another_curve(tmp_path: Path) -> None:
    """Also a second time from the same state; what goes on from the last one is the same curve."""
    rows = lines("a", [10, 20, 30, 20, 30, 40, 20, 30, 50])
    rows[-1]["told"] = 20
    rows.append({**rows[-1], "told": 30, "levels_told": 60})  # from 30 on, although past 50
    write_jsonl(tmp_path / "x.jsonl", rows)
    logs, notes = read_curves([tmp_path / "x.jsonl"])
    assert {label: log.x.tolist() for label, log in logs.items()} == {
        "x": [10, 20, 30],
        "x, part 2, from 10 levels on": [20, 30, 40],
        "x, part 3, from 10 levels on": [20, 30, 50],
        "x, part 4, from 30 levels on": [60],
    }
    assert "earlier state" in notes[0]


def test_a_teacher_whose_state_is_put_back_is_another_part_of_its_curve(tmp_path: Path) -> None:
    """A later process that goes on from the last state is not."""
    file, space = tmp_path / "x.jsonl", prl.Parameters({"a": (0.0, 1.0)})

    def go_on(teacher: prl.Teacher, lines: int) -> dict:
        for _ in range(lines):
            ids, _levels = teacher.ask(8)
            teacher.tell(ids, torch.zeros(8))
            teacher.log(file)
        return teacher.state_dict()

    early = go_on(first := prl.Teacher("plr", space, block=8), 2)
    last = go_on(first, 1)
    for state in (last, early):
        again = prl.Teacher("plr", space, block=8)
        again.load_state_dict(state)
        go_on(again, 2)
    assert {label: log.x.tolist() for label, log in read_curves([file]).logs.items()} == {
        "x": [8, 16, 24, 32, 40],
        "x, part 2, from 16 levels on": [24, 32],
    }


def test_shares_of_batches_are_entries_by_name(tmp_path: Path) -> None:
    rows = [{"told": 4, "drawn": {}, "shares": shares} for shares in ({"way": [0.2, 0.4]}, None)]
    write_jsonl(tmp_path / "x.jsonl", rows)
    found = read_log(tmp_path / "x.jsonl").entries
    np.testing.assert_allclose(found["shares/way"], [0.3, np.nan])


def test_logs_of_one_name_are_told_apart(tmp_path: Path) -> None:
    files = [tmp_path / name / "x.jsonl" for name in "ab"]
    for file in files:
        file.parent.mkdir()
        write_jsonl(file, [{"told": 4, "drawn": {}}])
    assert list(read_curves(files).logs) == list(map(str, files))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is not a log"),
        ('{"told": 1}\n', "is not a log"),
        ("{\n", "line 1"),
    ],
)
def test_what_is_no_log_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "x.jsonl").write_text(text)
    with pytest.raises(UnreadableRun, match=f"x.jsonl.*{message}"):
        read_log(tmp_path / "x.jsonl")
