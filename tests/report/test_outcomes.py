"""Tables and findings of runs whose outcomes are known."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np
import pytest

from proposer_rl.report.findings import findings
from proposer_rl.report.outcomes import (
    compare,
    comparisons,
    group_table,
    outcomes,
    run_table,
    tidy_cycles,
    tidy_metrics,
)
from proposer_rl.report.statistics import Interval
from proposer_rl.report.studies import Study, read_studies
from proposer_rl.report.tables import Table, to_csv, write
from tests.report.folders import cycle, write_run

SLOW = [0.0, 0.0, 0.05, 0.3, 0.5, 0.6]
FAST = [0.0, 0.4, 0.7, 0.85, 0.9, 0.9]


def curve_of(base: list[float], seed: int) -> list[float]:
    return [value * (1 - 0.01 * seed) for value in base]


def study_of(folder: Path, **curves: list[float]) -> Study:
    """Three seeds of each method; those called by a Proposer's name have cycles."""
    for method, base in curves.items():
        proposes = method in ("perf_gain", "task_difficulty")
        for seed in range(3):
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


def test_a_faster_method_is_found_better_by_every_outcome(tmp_path: Path) -> None:
    study = study_of(tmp_path, target=SLOW, hand_made=FAST)
    for row in comparisons(study):
        assert row.better == "hand_made"
        assert (row.one, row.other) == ("hand_made", "target")
        assert row.improvement.estimate == 1 and row.seeds is None
    first = comparisons(study)[0]
    # 80 % after 30 updates in all three seeds; never within 50.
    assert first.difference == (-20, -20, -20)


def test_equal_methods_are_undecided_and_more_seeds_are_asked_for(tmp_path: Path) -> None:
    study = study_of(tmp_path, target=SLOW, hand_made=[value * 1.001 for value in SLOW])
    rows = comparisons(study)
    assert all(row.better is None for row in rows)
    assert rows[0].difference == (0, 0, 0) and rows[0].seeds is None
    assert all(row.seeds > 100 for row in rows[1:])


def test_success_is_compared_at_the_horizon(tmp_path: Path) -> None:
    study = study_of(tmp_path, target=SLOW, hand_made=FAST)
    one, other = study.group("hand_made"), study.group("target")
    row = compare(outcomes(study)[2], one, other)
    expected = np.mean(curve_last(FAST)) - np.mean(curve_last(SLOW))
    assert row.difference.estimate == pytest.approx(expected)


def curve_last(base: list[float]) -> list[float]:
    return [curve_of(base, seed)[-1] for seed in range(3)]


def test_the_group_table_has_the_numbers(tmp_path: Path) -> None:
    study = study_of(tmp_path, perf_gain=FAST, target=SLOW)
    table = group_table(study)
    rows = {row["method"]: row for row in table.rows}
    assert rows["perf_gain"]["reached 80%"] == "3 of 3"
    assert rows["target"]["reached 80%"] == "0 of 3"
    (updates,) = (name for name in table.columns if name.startswith("updates to"))
    assert rows["perf_gain"][updates].estimate == 30
    assert rows["target"][updates] == (50, 50, 50)
    assert rows["target"]["IQM of ID success"] == pytest.approx(np.mean(curve_last(SLOW)))
    worst = rows["target"]["ID success, worst 10 %"]
    assert worst.estimate == pytest.approx(np.mean(curve_last(SLOW)) / 2)
    assert rows["perf_gain"]["evaluations"] == 150
    assert rows["perf_gain"]["with the curriculum's (M)"] == pytest.approx(50 * 700 / 1e6)


def test_the_tidy_metrics_are_those_of_the_runs(tmp_path: Path) -> None:
    study = study_of(tmp_path, perf_gain=FAST, target=SLOW)
    header, rows = tidy_metrics(study)
    read = list(csv.DictReader(io.StringIO(to_csv(header, rows))))
    assert len(read) == 2 * 3 * 6
    own = [row for row in read if row["method"] == "target" and row["seed"] == "1"]
    assert [float(row["id_success"]) for row in own] == pytest.approx(curve_of(SLOW, 1))
    header, rows = tidy_cycles(study)
    read = list(csv.DictReader(io.StringIO(to_csv(header, rows))))
    assert len(read) == 3 * 8 and read[0]["return_gain"] == "0.3 0.1"
    assert read[0]["histogram"] == "8 1 1 1 1 1"


def test_censored_runs_are_said_to_be(tmp_path: Path) -> None:
    text = run_table(study_of(tmp_path, target=SLOW)).to_markdown()
    assert text.count("censored at 50") == 3


def verdicts(study: Study) -> dict[str, str]:
    return {finding.claim: finding.verdict for finding in findings(study)}


def test_findings_that_hold_are_supported(tmp_path: Path) -> None:
    late = [0.0, 0.0, 0.0, 0.0, 0.3, 0.6]
    soon = [0.2, 0.5, 0.7, 0.85, 0.9, 0.9]
    found = verdicts(study_of(tmp_path, perf_gain=soon, task_difficulty=soon, target=late))
    assert found["The baseline that trains on the target alone stalls at first."] == "supported"
    assert found["Both Proposers learn almost at once."] == "supported"
    assert (
        found["Performance gain needs clearly fewer updates to 80% than the baseline."]
        == "supported"
    )
    assert found["Out of distribution the methods end up alike."] == "contradicted"
    assert found["Proposals start easy and grow harder."] == "supported"
    claim = "The maximum gain of the copies stays positive while the mean falls below zero."
    assert found[claim] == "supported"
    assert found["perf_gain beats target."] == "supported"


def test_findings_that_fail_are_contradicted(tmp_path: Path) -> None:
    found = verdicts(study_of(tmp_path, perf_gain=SLOW, task_difficulty=FAST, target=FAST))
    assert found["The baseline that trains on the target alone stalls at first."] != "supported"
    assert found["Both Proposers learn almost at once."] == "contradicted"
    assert (
        found["Performance gain needs clearly fewer updates to 80% than the baseline."]
        == "contradicted"
    )
    claim = "Performance gain beats task difficulty slightly, not significantly."
    assert found[claim] == "contradicted"
    assert found["perf_gain beats target."] == "contradicted"
    assert found["task_difficulty beats target."] == "undecided"


def test_findings_without_their_methods_have_no_data(tmp_path: Path) -> None:
    found = verdicts(study_of(tmp_path, domain_randomization=SLOW))
    assert set(found.values()) == {"no data"}


def test_numbers_are_written_with_their_interval() -> None:
    assert write(-0.04, 1) == "0.0" and write(1234567) == "1,234,567" and write(None) == "–"
    assert write(Interval(-1.5, -2, 0.25), 2) == "−1.50 [−2.00, 0.25]"
    assert write(Interval(3, math.nan, math.nan), 1) == "3.0"
    assert write(Interval(0.5, 0.25, 0.75)) == "0.500 [0.250, 0.750]"
    assert write(Interval(-43.3, -50, 30)) == "−43.3 [−50.0, 30.0]"


def test_tables_cannot_be_broken_by_what_is_in_them() -> None:
    table = Table("t", "T", "", [{"a": "=1+1|<b>`x`\n_", "b": None}])
    lines = table.to_markdown().splitlines()
    assert len(lines) == 3 and lines[2] == r"| =1+1\|\<b\>\`x\` \_ | – |"
    ((_, _), (text, empty)) = csv.reader(io.StringIO(table.to_csv()))
    assert text == "'=1+1|<b>`x`\n_" and empty == ""
