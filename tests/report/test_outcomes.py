"""Tables of runs whose outcomes are known."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import pytest

from proposer_rl.report.outcomes import answer, group_table
from proposer_rl.report.statistics import Interval
from proposer_rl.report.studies import Study, read_studies
from proposer_rl.report.tables import Table, write
from tests.report.folders import cycle, write_run

SEEDS = 6
SLOW = [0.0, 0.0, 0.05, 0.3, 0.5, 0.6]
FAST = [0.0, 0.4, 0.7, 0.85, 0.9, 0.9]


def curve_of(base: list[float], seed: int) -> list[float]:
    return [value * (1 - 0.01 * seed) for value in base]


def study_of(folder: Path, seeds: int = SEEDS, **curves: list[float]) -> Study:
    """Seeds of each method; those called by a Proposer's name have cycles."""
    for method, base in curves.items():
        proposes = method in ("perf_gain", "task_difficulty")
        for seed in range(seeds):
            cycles = []
            for i in range(8):
                harder = [[8 - i, 1, 1], [1, 1, 1 + i + seed]]
                cycles.append(cycle(i, [0.3 - 0.3 * i - 0.01 * seed, 0.1], harder, every=6))
            write_run(
                folder / f"{method}_{seed}",
                method,
                [seed],
                curve_of(base, seed),
                cycles=cycles if proposes else [],
                copies=600 if proposes else 0,
            )
    return read_studies(sorted(folder.iterdir()), None)[0][0]


def test_the_group_table_has_the_numbers(tmp_path: Path) -> None:
    study = study_of(tmp_path, perf_gain=FAST, target=SLOW)
    table = group_table(study)
    rows = {row["method"]: row for row in table.rows}
    assert rows["perf_gain"]["reached 80%"] == "6 of 6"
    assert rows["target"]["reached 80%"] == "0 of 6"
    (updates,) = (name for name in table.columns if name.startswith("updates to"))
    assert rows["perf_gain"][updates].estimate == 30
    assert write(rows["target"][updates]) == "50.0"  # nobody got there
    assert len(table.columns) == len(table.texts()[0]) == len(table.rows[0])
    assert rows["perf_gain"]["evaluations"] == 150
    assert rows["perf_gain"]["with the curriculum's (M)"] == pytest.approx(50 * 700 / 1e6)


def test_a_baseline_that_is_not_finished_is_none(tmp_path: Path) -> None:
    for seed in range(SEEDS):
        write_run(tmp_path / f"dr{seed}", "domain_randomization", [seed], [0.0], finished=False)
    study = study_of(tmp_path, plr=FAST, target=SLOW)
    assert study.baseline.label == "plr"
    assert len(answer(study)) == 2


def test_numbers_are_written_with_their_interval() -> None:
    assert write(-0.04, 1) == "0.0" and write(1234567) == "1,234,567" and write(None) == "–"
    assert write(-3.14e-8) == "−3.1e−08" and write(0.0) == "0.000" and write(0.0005) == "0.001"
    assert write(Interval(-1.5, -2, 0.25), 2) == "−1.50 [−2.00, 0.25]"
    assert write(Interval(3, math.nan, math.nan), 1) == "3.0"
    assert write(Interval(0.5, 0.25, 0.75)) == "0.500 [0.250, 0.750]"
    assert write(Interval(-43.3, -50, 30)) == "−43.3 [−50.0, 30.0]"


def test_tables_cannot_be_broken_by_what_is_in_them() -> None:
    table = Table("t", "T", "", [{"a": "=1+1|<b>`x`\n_", "b": None}])
    lines = table.to_markdown().splitlines()
    assert len(lines) == 3 and lines[2] == r"| =1+1\|\<b\>\`x\` \_ | – |"
    ((_, _), (text, empty)) = csv.reader(io.StringIO(table.to_csv()))
    assert text == "=1+1|<b>`x`\n_" and empty == ""
