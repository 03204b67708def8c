"""Tables that people wrote into README and docs have the numbers of the committed results."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
METHODS = ROOT / "results" / "curricula" / "tables" / "methods.csv"
# The column of a page, that of the results, and the digits that are shown; brackets are intervals.
INTERVALS = {
    "mean success along training": ("ID success, mean over 240 updates", 3),
    "success after 240 updates": ("ID success after 240 updates", 3),
    "out of distribution": ("OOD success after 240 updates", 3),
    "worst tenth": ("ID success, worst 10 %", 3),
    "updates to 80 % (at most 240)": ("updates to 80% ID success (at most 240)", 0),
}
FRAMES = "with the curriculum's (M)"
PAGES = ["README.md", "docs/comparison.md", "docs/first_order.md"]


def rows(page: str) -> Iterator[dict[str, str]]:
    """Of all tables of a page that compare methods by what the results tell."""
    names: list[str] = []
    for line in (ROOT / page).read_text(encoding="utf-8").splitlines():
        if not line.startswith("| "):
            names = names if line.startswith("|-") else []
            continue
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        names = names or cells
        if {"method", "mean success along training", "success after 240 updates"} <= set(names):
            row = dict(zip(names, cells, strict=True))
            if row["method"].startswith("`"):
                yield row


def shown(result: dict[str, str], name: str, digits: int) -> str:
    mean, low, high = (result[f"{name}{part}"] for part in ("", ", low", ", high"))
    if not low:
        return f"{float(mean):.{digits}f}"
    return f"{float(mean):.{digits}f} [{float(low):.{digits}f}, {float(high):.{digits}f}]"


@pytest.mark.parametrize("page", PAGES)
def test_the_tables_have_the_numbers_of_the_results(page: str) -> None:
    with METHODS.open(encoding="utf-8") as file:
        results = {row["method"]: row for row in csv.DictReader(file)}
    found = list(rows(page))
    assert len(found) >= 8
    for row in found:
        result = results[row["method"].strip("`").replace("`, `", ", ")]
        expected = {
            column: shown(result, name, digits) for column, (name, digits) in INTERVALS.items()
        } | {
            "frames, the curriculum's included": f"{float(result[FRAMES]):.2f} M",
            "evaluations": f"{float(result['evaluations']):,.0f}",
            "reached": result["reached 80%"],
        }
        for column in expected.keys() & row.keys():
            assert row[column] == expected[column], (row["method"], column)
