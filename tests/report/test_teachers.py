"""The page of teachers' logs: what is in the files is drawn, and what is no log is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

import proposer_rl as prl
from proposer_rl.cli.report import main
from proposer_rl.report import teachers
from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.teachers import drawings, read_log


def log(file: Path, curriculum: str) -> list[dict]:
    space = prl.Parameters({"<b>gravity": (5.0, 25.0), "ground": ["flat", "stairs"]}, bins=3)
    teacher = prl.Teacher(curriculum, space, block=16)
    rows = []
    for i in range(4):
        ids, _ = teacher.ask(12)
        teacher.tell(ids[:10], torch.arange(10.0) + i, [1] * 10 if i else None)
        rows.append(teacher.log(file))
    return rows


def test_a_page_has_the_entries_of_all_logs_and_what_was_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
    page = (tmp_path / "page" / "teachers.html").read_text()
    assert "teachers.html" in capsys.readouterr().out
    assert page.count("data:image/png") == 3 and not re.search("<[ib]>", page)


def test_shares_of_batches_are_entries_by_name(tmp_path: Path) -> None:
    rows = [{"told": 4, "drawn": {}, "shares": shares} for shares in ({"way": [0.2, 0.4]}, None)]
    (tmp_path / "x.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = read_log(tmp_path / "x.jsonl").entries
    np.testing.assert_allclose(found["share: way"], [0.3, np.nan])


def test_logs_of_one_name_are_told_apart_however_long_their_paths_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: dict[str, object] = {}
    monkeypatch.setattr(teachers, "drawings", lambda logs: shown.update(logs) or [])
    files = [tmp_path / ("deep" * 30) / name / "x.jsonl" for name in "abc"]
    for file in files:
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps({"told": 4, "drawn": {}}) + "\n")
    teachers.write_teachers(files, tmp_path / "page")
    assert len(shown) == len(files) and "x" in shown


@pytest.mark.parametrize("more", [["runs"], ["--threshold=0.5"], ["--baseline=target"]])
def test_what_is_of_runs_is_refused_beside_a_log(
    more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        main(["x.jsonl", *more, "-o", str(tmp_path / "page")])
    assert end.value.code == 2 and "without runs, --threshold and --base" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no log of a teacher"),
        (json.dumps({"told": 1}) + "\n", "is no log of a teacher"),
        ("{\n", "not a JSON object"),
        (json.dumps({"told": 1, "drawn": {"g": {"1": "many"}}}) + "\n", "could not convert"),
    ],
)
def test_what_is_no_log_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "x.jsonl").write_text(text)
    with pytest.raises(UnreadableRun, match=f"x.jsonl: .*{message}"):
        read_log(tmp_path / "x.jsonl")
