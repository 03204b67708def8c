"""The report as a whole: its page, its files, its command."""

from __future__ import annotations

import csv
import html
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from proposer_rl.cli.report import main
from proposer_rl.cli.watch import main as watch
from proposer_rl.report import build
from proposer_rl.report.build import write_report
from proposer_rl.report.figures import learning_curves
from tests.report.folders import TASK, cycle, page_data, write_rockets, write_run

HOSTILE = "<script>alert(1)</script>&\"'"


class Tags(HTMLParser):
    """All tags with their attributes, and the text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    runs = tmp_path_factory.mktemp("runs")
    for seed in range(2):
        cycles = [cycle(i, [0.1, -0.1], [[1, 2, 3], [4, 5, 6 + i]], every=10) for i in range(3)]
        told = {"levels": [0.1, 0.5, 0.25 * seed]}
        write_run(runs / f"p{seed}", "perf_gain", [seed], cycles=cycles, copies=600, **told)
        write_run(runs / f"t{seed}", "target", [seed], finished=seed == 0, **told)
    cycles[2]["\ud800"] = 1.0  # half of a pair: there is no such character
    half = runs / os.fsdecode(b"hostile\xff")
    facts = {"machine": "\ud800"}
    write_run(half, HOSTILE, cycles=cycles, ablation="../../up", facts=facts, **told)
    write_run(runs / "large", "target", task={**TASK, "title": "5×5 mazes", "measured": 5})
    return write_report([runs], tmp_path_factory.mktemp("out") / "report")


def test_the_page_holds_all_that_it_shows(report: Path) -> None:
    tags = Tags(report.read_text(encoding="utf-8"))
    assert not tags.open
    scripts = [attributes for tag, attributes in tags.found if tag == "script"]
    # What two sections draw, the library, and what is run.
    assert [one.get("type", "") for one in scripts] == ["text/plain"] * 3 + [""]
    assert not any("src" in one for one in scripts)
    assert not any(tag == "img" for tag, _ in tags.found)
    links = [attributes["href"] for tag, attributes in tags.found if tag == "a"]
    places = {attributes.get("id") for _, attributes in tags.found}
    assert links and all(link.startswith("#") and link[1:] in places for link in links)
    assert not [tag for tag, _ in tags.found if tag in ("link", "iframe", "object")]


def test_what_a_run_calls_itself_is_only_text(report: Path) -> None:
    page = report.read_text(encoding="utf-8")
    escaped = html.escape(HOSTILE).replace("&#x27;", "&#39;").replace("&quot;", "&#34;")
    assert HOSTILE not in page and escaped in page
    text = (report.parent / "report.md").read_text(encoding="utf-8")
    assert "<script>" not in re.sub(r"```bash\n.*?\n```\n", "", text, flags=re.DOTALL)
    inside = {path.resolve() for path in report.parent.rglob("*") if path.is_file()}
    assert all(report.parent.resolve() in path.parents for path in inside)
    assert not list(report.parent.parent.glob("*up*"))


def test_the_page_says_what_was_run_and_what_is_unfinished(report: Path) -> None:
    text = Tags(report.read_text(encoding="utf-8")).text
    assert "bin/train -m +method=perf_gain seed=0,1" in text
    assert "target seed 1 (20 updates)" in text
    assert "Tiny scale, 2×4 mazes" in text and "Tiny scale, 5×5 mazes" in text
    assert "python 3.11" in text
    # As it can be given again.
    assert re.search(rf"bin/report {re.escape(str(report.parents[2]))}/runs\d+\.", text)


def test_there_are_figures_and_tables_for_other_tools(report: Path) -> None:
    figures = {path.name for path in (report.parent / "figures").iterdir()}
    for name in ("learning_curves", "proposals"):
        for suffix in ("svg", "png"):
            assert f"tiny_scale_2_4_mazes_{name}.{suffix}" in figures
    for name in ("methods", "comparisons", "metrics", "training", "cycles", "levels"):
        file = report.parent / "tables" / f"tiny_scale_2_4_mazes_{name}.csv"
        rows = list(csv.DictReader(file.open(encoding="utf-8")))
        assert rows and None not in rows[0]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    write_run(tmp_path / "runs" / "a")
    return tmp_path / "runs"


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_the_same_runs_give_the_same_files(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "DRAWINGS", [learning_curves])
    for name in ("one", "two"):
        main([str(runs), "-o", str(tmp_path / name)])
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_a_report_is_replaced_and_nothing_else(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "DRAWINGS", [learning_curves])
    output = tmp_path / "report"
    main([str(runs), "-o", str(output)])
    (output / "figures" / "old.png").write_bytes(b"of a former report")
    (output / "notes.md").write_text("mine")
    main([str(runs), "-o", str(output), "--threshold", "0.5"])
    assert not (output / "figures" / "old.png").exists()
    assert (output / "notes.md").read_text() == "mine"
    assert "updates to 50%" in (output / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing"], "there is no such folder"),
        (["mine"], "mine: holds no runs"),
        (["runs", "--output=mine"], "use a new directory"),
        (["runs", "--threshold=nan"], "must be a number, got 'nan'"),
        (["runs", "--baseline=nobody"], "--baseline=nobody: must be one of target"),
        (["runs", "--compare=target,nobody"], "--compare=nobody: must be one of target"),
    ],
)
def test_what_cannot_be_reported_gets_one_line_and_leaves_all_as_it_was(
    arguments: list[str],
    message: str,
    runs: Path,
    tmp_path: Path,
    capsys,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    before = contents(tmp_path)
    with pytest.raises(SystemExit) as end:
        main([*arguments])
    *usage, line = capsys.readouterr().err.splitlines()
    assert end.value.code == 2 and message in line
    assert not usage or "nan" in message  # argparse shows how the command is used
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("undrawn")
def test_runs_that_have_measured_nothing_are_named(runs: Path, tmp_path: Path) -> None:
    for name, file in (("begun", "config.json"), ("broken", "error.json")):
        (runs / name).mkdir()
        (runs / name / file).write_text("{}")
    page = write_report([runs], tmp_path / "report")
    text = (page.parent / "report.md").read_text()
    assert all(f"not read: {name}: it has measured nothing" in text for name in ("begun", "broken"))


def test_a_run_that_has_just_begun_is_reported(
    tmp_path: Path, recwarn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "DRAWINGS", [learning_curves])
    write_run(tmp_path / "a", curve=[0.1], finished=False)
    page = write_report([tmp_path / "a"], tmp_path / "report")
    assert "target seed 0 (0 updates)" in (page.parent / "report.md").read_text()
    assert [str(warning.message) for warning in recwarn] == []


@pytest.mark.usefixtures("undrawn")
def test_the_baseline_can_be_chosen_among_the_methods(tmp_path: Path) -> None:
    for method in ("target", "plr"):
        for seed in range(5):
            write_run(tmp_path / "runs" / f"{method}{seed}", method, [seed], [0, 0.1 * seed + 0.3])
    folder, output = str(tmp_path / "runs"), tmp_path / "report"
    for arguments, baseline in (([], "plr"), (["--baseline=target"], "target")):
        main([folder, "-o", str(output), *arguments])
        rows = list(csv.DictReader((output / "tables" / "baseline.csv").open(encoding="utf-8")))
        found = {row["method"]: row["difference"] for row in rows}
        other = {"plr": "target", "target": "plr"}[baseline]
        assert found == {f"{baseline} (baseline)": "", other: "0"}
    assert "--baseline=target" in (output / "report.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("undrawn")
def test_planned_comparisons_are_named_by_labels(tmp_path: Path) -> None:
    """Those of ablations have a comma in them."""
    for place, method in enumerate(("target", "plr", "sfl")):
        for seed in range(5):
            folder = tmp_path / "runs" / f"{method}{seed}"
            curve = [0, 0.3 + 0.02 * seed * place + 0.1 * place]
            write_run(folder, method, [seed], curve, ablation="less" if place == 1 else "none")
    asked = "--compare=plr, less,target"
    main([str(tmp_path / "runs"), "-o", str(tmp_path / "report"), asked])
    file = tmp_path / "report" / "tables" / "baseline.csv"
    rows = {row["method"]: row for row in csv.DictReader(file.open(encoding="utf-8"))}
    assert list(rows) == ["sfl", "plr, less", "target (baseline)"]
    assert rows["plr, less"]["p (Holm)"] == rows["plr, less"]["p"] != ""
    assert rows["sfl"]["p (Holm)"] == "" and rows["sfl"]["verdict"] == "–"
    page = Tags((tmp_path / "report" / "report.html").read_text(encoding="utf-8")).text
    assert "'--compare=plr, less,target'" in page


ANYTHING = [
    {
        "updates": 0,
        "scores": [[1, 2], [3]],
        "note": "x",
        "rate": 0.25,
        "buffer": [3, 4],
        "ok": True,
    },
    {"updates": 20, "rate": None, "staleness": 1e300, "histogram": "no", "return_gain": ["a"]},
    {"updates": 40, "rate": float("nan"), "buffer": {}, "total": 10**400, "$\\bad{": 1, "\x07": 2},
    {"updates": 40, "histogram": [[[]]], "log_success_gain": [], "return_gain": 3, "buffer": [5]},
]


def test_the_report_is_built_for_any_task(tmp_path: Path, capsys) -> None:
    """One axis, no success, a return as headline, curricula that record what they like."""
    for seed in range(2):
        cycles = [cycle(i, [0.1, -0.1], [9 - i, 1, 1, 1], every=10) for i in range(3)]
        for record in cycles:
            del record["log_success_gain"]  # there is none without success
        write_rockets(tmp_path / "runs" / f"p{seed}", "perf_gain", seed, cycles=cycles)
        write_rockets(tmp_path / "runs" / f"a{seed}", "plr", seed, cycles=ANYTHING)
        write_rockets(tmp_path / "runs" / f"t{seed}", "target", seed)
    page = write_report([tmp_path / "runs"], tmp_path / "report")
    figures = {path.name for path in (page.parent / "figures").iterdir()}
    for name in ("learning_curves", "proposals"):
        assert f"{name}.svg" in figures
    text = Tags(page.read_text(encoding="utf-8")).text
    assert "Tiny scale, rockets" in text and "updates to 12.5 target return" in text
    drawn = json.dumps([data["measures"] for data in page_data(page)])
    assert "return gain max" in drawn and "log success" not in drawn
    assert "on batches of rockets" in text and "from 0 to 1" not in text
    assert not re.search("success of|log success|maze|obstacle|path length", text)
    rows = list(csv.DictReader((page.parent / "tables" / "cycles.csv").open(encoding="utf-8")))
    assert [row["rate"] for row in rows if row["method"] == "plr"] == ["0.25", "", "", ""] * 2
    watch([str(tmp_path / "runs"), "--once"])
    screen = capsys.readouterr().out
    assert "target return" in screen and "6 runs: 6 finished" in screen and "\x07" not in screen


def test_rates_are_explained(report: Path) -> None:
    assert "from 0 to 1" in Tags(report.read_text(encoding="utf-8")).text


def test_only_what_writes_a_page_loads_its_libraries(tmp_path: Path) -> None:
    """Help, and looking at runs, must come at once; every run draws its picture, and keeps little.

    Statistics take a training process 50 MiB.
    """
    asked = (
        "import sys, pathlib, proposer_rl.cli.report, proposer_rl.cli.watch; "
        "from proposer_rl.report.figures import draw_run; draw_run(pathlib.Path(sys.argv[1]), ''); "
        "print({'plotly', 'torch', 'scipy.special', 'scipy.stats'} & set(sys.modules))"
    )
    command = [sys.executable, "-c", asked, str(write_run(tmp_path / "run"))]
    said = subprocess.run(command, capture_output=True, text=True, check=True)
    assert said.stdout == "set()\n"
