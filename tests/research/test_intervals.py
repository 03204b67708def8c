"""The simulation of intervals against what theory says of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from research.intervals import LAWS, SEEDS, main, simulate


@pytest.mark.slow
def test_shares_are_those_of_theory() -> None:
    """Of order statistics exactly, of Student's for normal laws, and where a run in five fails."""
    found = simulate(4000).set_index(["law", "seeds", "method"])["coverage"]
    near = {"abs": 0.015}  # four standard errors
    for law in list(LAWS)[:4]:  # continuous, so that runs do not tie
        assert found[law, 5, "median: the report's"] == pytest.approx(1 - 2 / 2**5, **near)
        assert found[law, 10, "median: the report's"] == pytest.approx(1 - 22 / 2**10, **near)
    assert found.xs("median: the report's", level="method").min() >= 0.93
    for seeds in SEEDS:
        assert found["normal", seeds, "mean: Student"] == pytest.approx(0.95, **near)
        # Studies without a failure, 0.8^n of all, miss a mean that lies below all of their runs.
        assert found["one run in five fails", seeds, "mean: Student"] <= 1 - 0.8**seeds + 0.015


def test_the_page_is_printed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["--replications", "50", "-o", str(tmp_path / "page.md")])
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert page in capsys.readouterr().out and page.count("| one run in five fails |") == 2
