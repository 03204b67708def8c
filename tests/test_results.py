"""README and docs have the numbers of the committed results, these those of the published runs."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import pytest

from proposer_rl.report.findings import finding_table, findings
from proposer_rl.report.outcomes import comparison_table, group_table, run_table
from proposer_rl.report.runs import find_runs
from proposer_rl.report.studies import read_studies

ROOT = Path(__file__).parents[1]
FRAMES = "with the curriculum's (M)"
GYMNASIUM = "docs/your_gymnasium_environment.md"
# Pages with tables, updates of the runs in them, folder of their results, headline, least number of
# rows. A page has no two tables of runs of the same length.
TABLES = [
    ("README.md", 240, "curricula", "ID success", 20),
    ("docs/comparison.md", 240, "curricula", "ID success", 20),
    ("docs/first_order.md", 240, "curricula", "ID success", 8),
    ("docs/choice.md", 240, "curricula", "ID success", 8),
    ("docs/replay.md", 240, "sampled", "ID success", 11),
    ("README.md", 400, "medium", "ID success", 5),
    ("docs/comparison.md", 400, "medium", "ID success", 5),
    (GYMNASIUM, 40, "cartpole", "target success", 4),
    (GYMNASIUM, 80, "lunar_lander", "target success", 4),
    (GYMNASIUM, 60, "minigrid", "target success", 4),
]


def intervals(updates: int, headline: str) -> dict[str, tuple[str, int]]:
    """By the column of a page that of the results, and the digits shown; brackets are intervals."""
    return {
        "mean success along training": (f"{headline}, mean over {updates} updates", 3),
        f"success after {updates} updates": (f"{headline} after {updates} updates", 3),
        "out of distribution": (f"OOD success after {updates} updates", 3),
        "worst tenth": (f"{headline}, worst 10 %", 3),
        f"updates to 80 % (at most {updates})": (
            f"updates to 80% {headline} (at most {updates})",
            0,
        ),
    }


def rows(page: str, updates: int) -> Iterator[dict[str, str]]:
    """Of all tables of a page that compare methods by what the results tell."""
    names: list[str] = []
    for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
        if not line.startswith("| "):
            names = names if line.startswith("|-") else []
            continue
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        names = names or cells
        if {"method", "mean success along training", f"success after {updates} updates"} <= set(
            names
        ):
            row = dict(zip(names, cells, strict=True))
            if row["method"].startswith("`"):
                yield row


def shown(result: dict[str, str], name: str, digits: int) -> str:
    mean, low, high = (result[f"{name}{part}"] for part in ("", ", low", ", high"))
    if not low:
        return f"{float(mean):.{digits}f}"
    text = f"{float(mean):.{digits}f} [{float(low):.{digits}f}, {float(high):.{digits}f}]"
    return text.replace("-", "−")


@pytest.mark.parametrize(("page", "updates", "folder", "headline", "least"), TABLES)
def test_the_tables_have_the_numbers_of_the_results(
    page: str, updates: int, folder: str, headline: str, least: int
) -> None:
    methods = ROOT / "results" / folder / "tables" / "methods.csv"
    with methods.open(encoding="utf-8") as file:
        results = {row["method"]: row for row in csv.DictReader(file)}
    found = list(rows(page, updates))
    assert len(found) >= least
    for row in found:
        result = results[row["method"].strip("`").replace("`, `", ", ")]
        expected = {
            column: shown(result, name, digits)
            for column, (name, digits) in intervals(updates, headline).items()
            if column in row
        } | {
            "frames, the curriculum's included": f"{float(result[FRAMES]):.2f} M",
            "evaluations": f"{float(result['evaluations']):,.0f}",
            "reached": result["reached 80%"],
        }
        for column in expected.keys() & row.keys():
            assert row[column] == expected[column], (row["method"], column)


@pytest.mark.parametrize("runs", sorted((ROOT / "results").glob("*/runs")), ids=str)
def test_the_tables_come_out_of_the_published_runs(runs: Path) -> None:
    """To the last digit but one: processors may round a sum differently."""
    (study,), notes = read_studies(find_runs([runs]), None)
    assert notes == []
    made = [group_table(study), comparison_table(study), run_table(study)]
    for table in (*made, finding_table(study, findings(study))):
        expected = list(csv.reader(io.StringIO(table.to_csv())))
        with (runs.parent / "tables" / f"{table.name}.csv").open(encoding="utf-8") as file:
            committed = list(csv.reader(file))
        assert len(committed) == len(expected)
        for row, other in zip(committed, expected, strict=True):
            assert [number(cell) for cell in row] == [pytest.approx(number(c)) for c in other]


def number(cell: str) -> float | str:
    try:
        return float(cell)
    except ValueError:
        return cell
