"""What a reader is told first, from runs whose outcome is known."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from proposer_rl.report import page
from proposer_rl.report.comparisons import UNDECIDED
from proposer_rl.report.outcomes import answer, comparison_table, first_rows, meaning
from proposer_rl.report.studies import Study, read_studies
from tests.report.folders import study_in, write_ends, write_run

NOISE = np.random.default_rng(1).normal(0, 1, (8, 6))


def study_of(folder: Path, ends: Mapping[str, float], seeds: int = 6, noise: float = 0.01) -> Study:
    """Methods whose mean along training is about half of their end."""
    chances = noise * NOISE[:, :seeds]
    return write_ends(folder, {m: end + chances[i] for i, (m, end) in enumerate(ends.items())})


def told(folder: Path, ends: Mapping[str, float], seeds: int = 6) -> Sequence[str]:
    sentences = answer(study_of(folder, ends, seeds))
    assert all(sentence.endswith(".") for sentence in sentences)
    return sentences


def test_the_best_is_named_with_what_it_costs_and_how_sure_that_is(tmp_path: Path) -> None:
    ends = {"ours": 0.9, "domain_randomization": 0.5, "worse": 0.2}
    first, second, third = told(tmp_path / "all", ends)
    assert re.fullmatch(
        r"ours reaches 80% ID success after 20 updates, which domain_randomization does not within "
        r"20, at 1× the frames and 1× the seconds; ID success, mean over 20 updates: "
        r"\+0\.\d{3} \[0\.\d{3}, 0\.\d{3}\], better, p < 0\.001\.",
        first,
    )
    assert second == (
        "ours is significantly better than the baseline, domain_randomization; "
        "worse is significantly worse."
    )
    assert third.startswith("Of 3 methods, ours has the highest mean over seeds (0.4")
    assert third.endswith("it is significantly better than all others.")
    _, second, third = told(tmp_path / "some", {"twin": 0.9, **ends})
    assert "better than 2 of the 3 others, with no significant difference to " in third
    assert second.startswith(("twin and ours are signif", "ours and twin are signif"))


def test_a_sentence_tells_the_updates_and_costs_of_both(tmp_path: Path) -> None:
    """Of six runs each; four of ours get there, whose baseline does later and with few frames."""
    for seed in range(6):
        ours = [0.0, 0.9, 0.9, 0.9] if seed < 4 else [0.0, 0.1, 0.1, 0.2]
        write_run(tmp_path / f"a{seed}", "ours", [seed], ours, copies=800)
        write_run(tmp_path / f"b{seed}", "target", [seed], [0.0, 0.1, 0.2, 0.8 + seed / 100])
    (study,), _ = read_studies(sorted(tmp_path.iterdir()), None, "target")
    assert answer(study)[0].startswith(
        "ours reaches 80% ID success after 10 updates (4 of 6) where target takes 30, at 9× the "
        "frames and 1× the seconds; "
    )


def test_what_is_undecided_is_said_to_be(tmp_path: Path) -> None:
    first, second = told(tmp_path, {"ours": 0.5, "domain_randomization": 0.5})
    assert "undecided, p 0." in first
    assert first.startswith("Neither ours nor domain_randomization reaches 80% ID success within ")
    assert second == (
        "No method is significantly better than the baseline, domain_randomization; "
        "no significant difference for 1."
    )


def test_what_has_hardly_learnt_is_not_said_to_be_level(tmp_path: Path) -> None:
    ends = {"ours": 0.09, "domain_randomization": 0.01, "twin": 0.01}
    study = study_of(tmp_path, ends, noise=0.001)
    verdicts = [row["verdict"] for row in comparison_table(study).rows]
    assert verdicts.count("nothing learnt") == 2 and verdicts.count(UNDECIDED) == 1
    first, second, third = answer(study)
    assert third.endswith("but it is not shown to have learnt.") and "significant" not in third
    assert first.endswith("nothing learnt, p < 0.001.")
    assert second == (
        "No method is significantly better than the baseline, domain_randomization; "
        "for 1 the better one is not shown to have learnt; no significant difference for 1."
    )


def test_order_and_sentences_are_by_the_mean_alone(tmp_path: Path) -> None:
    """The median would have it the other way round."""
    means = {"risky": [0.3, 0.31, 0.32, 0.95, 0.96], "steady": [0.5, 0.51, 0.52, 0.53, 0.54]}
    for method, curves in means.items():
        for seed, value in enumerate(curves):
            write_run(tmp_path / f"{method}{seed}", method, [seed], [value] * 3)
    (study,), _ = read_studies(sorted(tmp_path.iterdir()), None, "steady")
    assert [row.label for row in first_rows(study)] == ["risky", "steady"]
    assert "mean over 20 updates: +0.048 [" in answer(study)[0]


def test_p_is_corrected_for_the_comparisons_that_were_planned(tmp_path: Path) -> None:
    """Against SciPy's paired t test and Holm's steps by hand."""
    spread = np.array([-1.2, -0.8, 0.2, -0.2, 0.8, 1.2])
    differences = {"a": 0.2 + 0.01 * spread, "b": 0.05 + 0.045 * spread, "c": 0.05 * spread}
    for method, own in {**differences, "domain_randomization": 0 * spread}.items():
        for seed in range(6):
            end = 0.5 + 0.01 * seed + own[seed]
            write_run(tmp_path / f"{method}{seed}", method, [seed], [0.0, end, end])
    study = study_in(tmp_path)
    means = {
        group.label: [np.trapezoid(run.metrics["id_success"]) / 2 for run in group.runs]
        for group in study.groups
    }
    alone = {m: stats.ttest_rel(means[m], means["domain_randomization"]).pvalue for m in "abc"}
    assert alone["a"] < alone["b"] < 0.05 < 2 * alone["b"]
    whole = {row.label: row for row in first_rows(study)}
    assert whole["a"].decision.p == pytest.approx(3 * alone["a"])
    assert whole["b"].decision.p == pytest.approx(max(3 * alone["a"], 2 * alone["b"]))
    # Its interval is without zero: the cell tells why that does not decide.
    assert whole["b"].difference.low > 0
    p, q = (float(f"{x:.2g}") for x in (2 * alone["b"], alone["b"]))
    assert whole["b"].verdict == f"undecided: p {p:g} in 3 tests, {q:g} alone"
    planned = replace(study, planned=("b", "domain_randomization"))
    found = {row.label: row for row in first_rows(planned)}
    assert found["b"].verdict == f"better, p {q:g}" and found["a"].verdict == "–"
    assert found["b"].difference == whole["b"].difference
    first, second = answer(planned)
    assert first.endswith(f"better, p {q:g}.") and second.startswith("b is significantly better")
    (row, *_) = comparison_table(planned).rows
    assert (row["first"], row["second"]) == ("b", "domain_randomization")
    assert row["p (Holm)"] == pytest.approx(alone["b"])
    # Of two others the last is the baseline.
    assert replace(study, planned=("a", "c")).baseline.label == "c"


@pytest.mark.parametrize("other", [0.2, 3e-5, -0.4])
def test_the_numbers_above_the_dots_do_not_overlap(tmp_path: Path, other: float) -> None:
    """A character is at most 7 pixels wide in its font of 11."""
    ends = {"a": 0.5 + other, "b": 0.49, "domain_randomization": 0.5}
    study = study_of(tmp_path, ends, noise=0.0)
    first = page.first(page.first_of_study(study), first_rows(study), [], ())
    spans = sorted((x - 3.2 * len(t), x + 3.2 * len(t)) for x, t in first["ticks"])
    assert "0" in dict(map(reversed, first["ticks"])) and len(spans) > 1
    assert spans[0][0] >= 0 and spans[-1][1] <= first["wide"]
    assert all(one[1] < other[0] for one, other in pairwise(spans))


def test_few_seeds_decide_nothing(tmp_path: Path) -> None:
    first, second = told(tmp_path, {"ours": 0.9, "domain_randomization": 0.1}, seeds=4)
    assert "significant" not in first and first.endswith("too few seeds.")
    assert "Too few seeds" in second


def test_a_method_alone_is_compared_with_nothing(tmp_path: Path) -> None:
    first, second = told(tmp_path, {"ours": 0.9})
    assert first.startswith("ours is the only method here") and "Nothing is compared" in second
    write_run(tmp_path / "shorter", "plr", curve=[0.0, 0.1])
    assert answer(study_in(tmp_path))[0].startswith(
        "ours is the only method with runs of 20 updates"
    )


def test_what_a_method_does_is_what_its_run_recorded(tmp_path: Path) -> None:
    about = {"about": {"method": "Mine.", "ablation": "Half."}}
    write_run(tmp_path / "a", "mine", facts=about, ablation="less")
    write_run(tmp_path / "b", "unheard")
    (study,), _ = read_studies(sorted(tmp_path.iterdir()), None)
    found = {group.label: meaning(group) for group in study.groups}
    assert found == {
        "mine, less": "Mine. Changed here: Half.",
        "unheard": "Its runs do not say what it does.",
    }
