"""Methods over several tasks, against numbers computed by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy import stats

from proposer_rl.cli.report import main
from proposer_rl.report import publish
from proposer_rl.report.arena import Arena, answer, arena, differences, summary, task_table
from proposer_rl.report.studies import read_studies
from tests.report.folders import TASK, write_rockets, write_run

SPREAD = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
ERROR = np.sqrt(0.00625 / 5)  # of a mean of these
OF_FOUR, OF_EIGHT = 2.776445, 2.306004  # Student's quantiles of 97.5 %
# By task and method, which every evaluation of the five seeds measures.
MEANS = {
    "a": {"target": 0.5, "domain_randomization": 0.3, "plr": 0.6 + SPREAD},
    "b": {"target": 0.1, "domain_randomization": 0.6, "plr": 0.5 + SPREAD},
}


def write_task(folder: Path, name: str, means: dict[str, object], seeds: int = 5) -> None:
    for method, mean in means.items():
        for seed, value in enumerate(np.broadcast_to(np.asarray(mean, float), seeds)):
            facts = {"overrides": [f"task=arena/{name}", f"+method={method}", f"seed={seed}"]}
            task = {**TASK, "title": "one environment", "measured": name}
            place = folder / name / f"{method}{seed}"
            write_run(place, method, [seed], [value] * 3, task=task, facts=facts)


def found(folder: Path, *baselines: str) -> Arena | None:
    return arena(read_studies(sorted(folder.glob("*/*")), None)[0], baselines)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name, means in MEANS.items():
        write_task(folder, name, means)
    write_task(folder, "c", {"domain_randomization": 0.1, "plr": 0.2}, 1)  # no target
    for method in ("target", "domain_randomization"):  # no rate
        write_rockets(folder / "rockets" / method, method, 0)
    return folder


def test_the_worst_case_and_the_mean_are_to_the_better_baseline_of_each_task(runs: Path) -> None:
    compared = found(runs)
    assert compared is not None and [*compared.tasks] == ["arena/a", "arena/b"]
    assert compared.better == {"arena/a": "target", "arena/b": "domain_randomization"}
    plr, uniform, target = summary(compared).rows
    assert [row["method"] for row in (plr, uniform, target)] == [
        "plr",
        "domain_randomization",
        "target",
    ]
    half, whole = ERROR * OF_FOUR, ERROR / np.sqrt(2) * OF_EIGHT
    assert plr["worst case"] == pytest.approx((-0.1, -0.1 - half, -0.1 + half), abs=1e-6)
    assert plr["its task"] == "arena/b" and plr["tasks"] == 2
    assert plr["mean over tasks"] == pytest.approx((0, -whole, whole), abs=1e-6)
    # Where no run differs from another there is nothing to be uncertain of.
    assert uniform["worst case"] == pytest.approx((-0.2, -0.2, -0.2))
    assert target["mean over tasks"].estimate == pytest.approx(-0.25)
    lead = "plr minus it, mean over tasks"
    assert uniform[lead] == pytest.approx((0.1, 0.1 - whole, 0.1 + whole), abs=1e-6)
    assert target[lead] == pytest.approx((0.25, 0.25 - whole, 0.25 + whole), abs=1e-6)
    small, large = (2 * stats.t.sf(mean / ERROR * np.sqrt(2), 8) for mean in (0.25, 0.1))
    assert (target["p (Holm)"], uniform["p (Holm)"]) == pytest.approx((2 * small, large))
    lead, first, second = answer(compared)
    best = "plr has the best worst case: a difference of −0.100 [−0.198, −0.002]"
    assert first.startswith(f"Of 3 methods on 2 tasks, {best} to the better of domain_random")
    assert second == "In the mean over tasks it is significantly better than 2 of the 2 others."


def test_each_method_is_beside_the_baseline_in_the_mean_over_tasks(runs: Path) -> None:
    compared = found(runs)
    assert compared is not None
    plr, uniform, target = compared.rows
    assert [row.label for row in compared.rows] == ["plr", "domain_randomization", "target"]
    whole = ERROR / np.sqrt(2) * OF_EIGHT  # of the mean of two tasks, each of five pairs
    assert plr.difference == pytest.approx((0.1, 0.1 - whole, 0.1 + whole), abs=1e-6)
    p = 2 * stats.t.sf(0.1 / ERROR * np.sqrt(2), 8)
    assert plr.decision is not None and plr.decision.p == pytest.approx(p)
    # Without any spread nothing is tested, so that it does not count.
    assert target.difference.estimate == pytest.approx(-0.15) and target.verdict != "–"
    assert (plr.frames, plr.seconds) == (1, 1) and uniform.decision is None
    assert (plr.worst, plr.reached) == ("−0.100 arena/b", "0 of 2")
    # Four of its five seeds get to 0.55 on the one task, and two on the other.
    lower = {task: replace(study, threshold=0.55) for task, study in compared.tasks.items()}
    plr, uniform, target = Arena(lower, compared.baselines).rows
    assert [row.reached for row in (plr, uniform, target)] == ["1 of 2", "1 of 2", "0 of 2"]
    assert "threshold on 1 of them, where domain_randomization does on 1, at 1× the" in plr.says


def test_every_task_has_the_differences_to_each_baseline(runs: Path) -> None:
    compared = found(runs)
    assert compared is not None
    rows = {(row["method"], row["task"]): row for row in task_table(compared).rows}
    assert len(rows) == 6
    row = rows["plr", "arena/b"]
    assert row["minus target"] == pytest.approx((0.4, 0.4 - 0.098161, 0.4 + 0.098161), abs=1e-5)
    assert row["minus domain_randomization"] == row["minus the better"]
    assert row["the better"] == "domain_randomization" and row["seeds"] == 5
    assert rows["target", "arena/a"]["minus target"] is None
    assert rows["target", "arena/a"]["minus the better"] == (0, 0, 0)
    figure = Figure()
    differences(compared).panels[0](figure)
    drawn = [line.get_xdata()[0] for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert sorted(drawn) == pytest.approx([-0.1, -0.1, 0.1])  # the worst has a ring


def test_other_baselines_are_other_tasks(runs: Path, tmp_path: Path) -> None:
    compared = found(runs, "domain_randomization")
    assert compared is not None and [*compared.tasks] == ["arena/a", "arena/b", "arena/c"]
    assert compared.reference == "domain_randomization"
    assert "minus the better" not in task_table(compared).columns
    last = summary(compared).rows[-1]
    assert (last["method"], last["tasks"]) == ("target", "2 of 3")
    # One run of each on the third task tells nothing of how much it varies.
    leader = summary(compared).rows[0]
    assert np.isnan(leader["mean over tasks"].low)
    write_task(tmp_path, "a", MEANS["a"])
    assert found(tmp_path) is None


def test_one_usual_baseline_is_enough(tmp_path: Path) -> None:
    for name in MEANS:
        write_task(tmp_path, name, {"target": 0.5, "plr": 0.6 + SPREAD})
    compared = found(tmp_path)
    assert compared is not None and compared.baselines == ("target",)
    assert [row.label for row in compared.rows] == ["plr", "target"]


@pytest.mark.usefixtures("undrawn")
def test_a_report_of_several_tasks_begins_with_all_of_them(runs: Path, tmp_path: Path) -> None:
    main([str(runs), "-o", str(tmp_path / "out")])
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    assert page.index('id="arena"') < page.index('id="study-1"')
    text = (tmp_path / "out/report.md").read_text(encoding="utf-8")
    assert text.index("## Over all tasks") < text.index("## Tiny scale")
    for name in ("arena.csv", "arena.md", "arena_tasks.csv", "arena_tasks.md"):
        assert (tmp_path / "out/tables" / name).is_file()
    assert (tmp_path / "out/figures/arena.svg").is_file()


def test_a_published_study_begins_with_all_tasks(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("learning_curves", "heat_maps"):
        monkeypatch.setattr(publish, name, lambda study: None)
    publish.publish([runs], tmp_path / "study")
    text = (tmp_path / "study/README.md").read_text(encoding="utf-8")
    assert text.index("## Over all tasks") < text.index("## Tiny scale")
    assert (tmp_path / "study/figures/arena.png").is_file()
