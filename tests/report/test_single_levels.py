"""Single levels: their worst share by its definition, and what goes to the tables."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from proposer_rl.report import build
from proposer_rl.report.charts import charts
from proposer_rl.report.measures import worst, worst_means
from proposer_rl.report.statistics import median_interval, median_of
from proposer_rl.report.studies import Study, read_studies
from tests.report.folders import TASK, write_run

scores = st.lists(st.floats(0, 1, width=16), min_size=1, max_size=9)


@given(scores, st.integers(1, 40))
def test_the_worst_mean_is_that_of_the_lowest_part(values: list[float], parts: int) -> None:
    """Every level cut into 40 equal parts, of which the lowest are taken."""
    each = [Fraction(value) for value in sorted(values) for _ in range(40)]
    lowest = each[: parts * len(values)]
    found = worst_means(np.array([values]), np.array([parts / 40]))
    assert found.shape == (1, 1)
    assert found[0, 0] == pytest.approx(float(sum(lowest) / len(lowest)), abs=1e-9)


LEVELS = {"target": [0.2, 0.4, 0.6], "domain_randomization": [0.1, 0.9, 0.6]}


def study_of(folder: Path, exact: bool | None = True, **options: Any) -> Study:
    task = TASK if exact is None else {**TASK, "exact": exact}
    for method, levels in LEVELS.items():
        for seed in range(5):
            told = {"levels": [value + 0.01 * seed for value in levels], "task": task}
            write_run(folder / f"{method}{seed}", method, [seed], **told, **options)
    write_run(folder / "older", "hand_designed", task=task)
    return read_studies(sorted(folder.iterdir()), None)[0][0]


def test_the_worst_share_is_a_median_with_its_interval(tmp_path: Path) -> None:
    study = study_of(tmp_path)
    (of,) = worst(study)[1].axes.values()
    series = [of(group) for group in study.groups]
    assert [one is None for one in series] == [False, True, False]  # the older folder has none
    median, low, high = (ends[-1] for ends in median_of(series[2]))
    known = median_interval([0.4 + 0.01 * seed for seed in range(5)])
    assert (median, low, high) == pytest.approx(known)


@pytest.mark.parametrize(
    ("exact", "text"),
    [(True, "no second evaluation"), (False, "selection bias makes"), (None, "do not say")],
)
@pytest.mark.usefixtures("undrawn")
def test_the_page_says_whether_selection_bias_is_in_it(
    exact: bool | None, text: str, tmp_path: Path
) -> None:
    study_of(tmp_path / "runs", exact)
    page = build.write_report([tmp_path / "runs"], tmp_path / "report")
    assert text in page.read_text(encoding="utf-8")


def test_the_page_has_what_every_method_reaches_on_each_level(tmp_path: Path) -> None:
    drawn = charts(study_of(tmp_path))
    labels = [method["label"] for method in drawn["methods"]]
    assert labels[drawn["baseline"]] == "domain_randomization"
    assert [measure["name"] for measure in drawn["levels"]] == [
        "ID success rate",
        "OOD success rate",
    ]
    means = dict(zip(labels, drawn["levels"][0]["methods"], strict=True))
    assert means["hand_designed"] is None  # the older folder has none
    for method, levels in LEVELS.items():
        assert means[method] == pytest.approx([value + 0.02 for value in levels])


def test_levels_of_runs_that_are_not_at_the_horizon_do_not_count(tmp_path: Path) -> None:
    write_run(tmp_path / "short", "plr", [0], [0, 0.5], levels=[1.0, 1.0, 1.0], finished=False,
              task={**TASK, "exact": True})  # fmt: skip
    write_run(tmp_path / "odd", "target", [9], levels=[1.0], task={**TASK, "exact": True})
    study = study_of(tmp_path)
    (plr,) = (group for group in study.groups if group.label == "plr")
    target = study.group("target")
    assert study.group("plr") is None and study.scores(plr, "id_success") is None
    assert target is not None and study.scores(target, "id_success").shape == (5, 3)
