"""README and docs have the numbers that come out of the committed results."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import OmegaConf

from proposer_rl.cli.groups import arranged
from proposer_rl.methods import completed
from proposer_rl.recipes import composed, plain_values
from proposer_rl.report.comparisons import UNDECIDED
from proposer_rl.report.outcomes import comparison_table, group_table
from proposer_rl.report.studies import read_studies
from proposer_rl.report.tables import escape_markdown
from research import pages
from tests.committed import needs_results

pytestmark = needs_results
ROOT = Path(__file__).parents[1]
FRAMES = "with the curriculum's (M)"


@cache
def tables(study: str) -> dict[str, list[dict[str, str]]]:
    """The tables of methods and of comparisons of a study, as ``bin/report`` writes them."""
    found, notes = read_studies([ROOT / "results" / study], None)
    assert notes == []
    return {
        name: [row for one in found for row in csv.DictReader(io.StringIO(table(one).to_csv()))]
        for name, table in {"methods": group_table, "comparisons": comparison_table}.items()
    }


def test_the_published_proposer_can_be_used(
    train: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the mazes of its scale; it gives a beginner paths that are shorter than the target's."""
    monkeypatch.chdir(ROOT)
    learnt = OmegaConf.load(ROOT / "conf/sweep/medium_frozen.yaml").hydra.sweeper.params.checkpoint
    few = ["solver.batch_size=64", "task.evaluation.levels=4", "schedule.updates=1"]
    arguments = ["+method=frozen_proposer", "+scale=medium", f"checkpoint={learnt}", *few]
    assert train(*arguments, "compute.progress=false", f"hydra.run.dir={tmp_path}") == 0
    assert pd.read_csv(tmp_path / "training.csv")["path_length"].item() < 12


# Pages, or sections of them, whose intervals are all of studies in the repository; and how many.
PROSE = {
    "README.md": 5,
    "docs/explanation/filtering.md": 5,
    "docs/explanation/first_order.md#Results": 4,
    "docs/explanation/proposer.md#Results": 3,
    "docs/explanation/results.md": 49,
    "docs/how_to/reuse_a_proposer.md": 2,
}
NUMBER = r"[−]?\d*\.\d+"
INTERVAL = re.compile(rf"\+?(?P<shown>{NUMBER} \[{NUMBER}, {NUMBER}\])")
P_VALUE = re.compile(r",? \(?(?:undecided, )?p = (0?\.\d+)")


def written(mean: float, low: float, high: float) -> Iterator[str]:
    """An interval as prose has it, of a difference or of the same with its sides exchanged."""
    for digits in (2, 3):
        for shown in ((mean, low, high), (-mean, -high, -low)):
            mean_text, *bounds = (f"{x:.{digits}f}".replace("-", "−") for x in shown)
            yield f"{mean_text} [{', '.join(bounds)}]"


@pytest.fixture(scope="module")
def told() -> dict[str, list[dict[str, str]]]:
    """By every interval that a table has, the rows that have it; none if it is one of a page."""
    found: dict[str, list[dict[str, str]]] = {}
    for study in (file.parent.name for file in (ROOT / "results").glob("*/runs.csv.xz")):
        for row in (row for table in tables(study).values() for row in table):
            for name in (name for name in row if row.get(f"{name}, low")):
                bounds = (float(row[f"{name}{part}"]) for part in ("", ", low", ", high"))
                for text in written(*bounds):
                    found.setdefault(text, []).append(row)
    for page in (ROOT / "results").rglob("*.md"):
        for line in page.read_text(encoding="utf-8").replace("\\", "").splitlines():
            if line.startswith("|"):
                for match in INTERVAL.finditer(line):
                    found.setdefault(match["shown"], [])
    return found


@pytest.mark.parametrize(("page", "least"), PROSE.items())
def test_the_prose_has_the_numbers_and_verdicts_of_the_tables(
    page: str, least: int, told: dict[str, list[dict[str, str]]]
) -> None:
    file, _, heading = page.partition("#")
    whole = (ROOT / file).read_text(encoding="utf-8")
    section = whole.partition(f"## {heading}\n")[2].partition("\n## ")[0] if heading else whole
    text = " ".join(section.split())
    seen = list(INTERVAL.finditer(text))
    assert len(seen) >= least
    for match in seen:
        around = text[match.start() - 130 : match.end() + 130]
        assert match["shown"] in told, around
        compared = [row for row in told[match["shown"]] if row.get("verdict")]
        p_value = P_VALUE.match(text, match.end())
        if p_value:
            digits = len(p_value[1].partition(".")[2])
            known = [f"{float(row['p (Holm)']):.{digits}f}" for row in compared]
            assert f"0.{p_value[1].partition('.')[2]}" in known, around
        if text.startswith((", undecided", " (undecided"), match.end()):
            assert UNDECIDED in {row["verdict"] for row in compared}, around
        # An interval without zero looks like a verdict, which after correction it need not be.
        one_sided = ("[−" in match[0]) == (", −" in match[0])
        if one_sided and {row["verdict"] for row in compared} == {UNDECIDED}:
            assert re.search("decided|not told|not distinguishable|no significant", around), around


def test_numbers_without_an_interval_are_those_of_the_tables() -> None:
    """Medians of too few seeds, the dearest scores from episodes, and how often Student covers."""
    text = {
        name: (ROOT / f"docs/explanation/{name}.md").read_text(encoding="utf-8")
        for name in ("results", "outcome_model", "measurement")
    }
    (section,) = re.findall(r"## At the paper's scale\n(.*?)\n##", text["results"], re.DOTALL)
    ends = {
        row["method"]: f"{float(row['ID success after 750 updates']):.3f}"
        for row in tables("paper")["methods"]
    }
    assert {method: end for end, method in re.findall(r"(0\.\d+) \(`(\w+)`\)", section)} == ends
    dearest = max(
        float(row[FRAMES]) / float(row["frames (M)"]) for row in tables("sampled")["methods"]
    )
    assert f"cost up to {dearest - 1:.0f} times the Solver's own frames" in text["outcome_model"]
    intervals = (ROOT / "results/intervals.md").read_text(encoding="utf-8")
    (covered,) = re.findall(r"one run in five fails \| 5 \| (0\.\d+)", intervals)
    assert (
        f"Student's interval covers {float(covered):.0%}".replace("%", " %") in text["measurement"]
    )


GONE = {"first_order_sampled", "first_order_proposer_sampled"}  # after the tag before-0.1


@pytest.mark.parametrize("study", ["curricula", "medium", "paper", "paper_480"])
def test_a_run_of_today_is_of_the_same_variant_as_the_published_ones(study: str) -> None:
    """With a key more or less it would stand beside them, and be compared with them."""
    (found,), _ = read_studies([ROOT / "results" / study], None)
    for run in (
        group.runs[0] for group in found.groups if group.runs[0].config["method"] not in GONE
    ):
        words = [word for word in run.facts["overrides"] if not word.startswith(("seed", "hydra."))]
        values = completed(plain_values(composed(arranged(words)), resolve=True))
        aside = {"seed", "seeds", "schedule", "precision", "compute", "logger"}
        now, then = ({k: each[k] for k in each.keys() - aside} for each in (values, run.config))
        assert now == then, run.folder.name


@pytest.mark.parametrize("name", ["curricula", pytest.param("medium", marks=pytest.mark.slow)])
def test_the_committed_pages_come_out_of_the_committed_results(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Word for word, in a clean clone; their pictures are left out."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(
        pages,
        "_picture",
        lambda drawing, _: f"![{escape_markdown(drawing.title)}](figures/{drawing.name}.png)",
    )
    study = Path("results", name)
    given = [str(study)]
    if name == "medium":
        given += ["--scores", str(study / "scores.csv")]
        given += ["--seconds", *map(str, sorted(study.glob("seconds*.json")))]
    pages.main([*given, "-o", str(tmp_path)])
    for page in (pages.CHOICE, pages.CLAIMS):
        lines = [
            (folder / page).read_text(encoding="utf-8").splitlines() for folder in (study, tmp_path)
        ]
        assert f"bin/research pages {' '.join(given)} -o {study}" in lines[0]
        before, after = ([line for line in text if "bin/research" not in line] for text in lines)
        assert before == after
