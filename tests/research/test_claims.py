"""The paper's claims, of runs whose outcomes are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from proposer_rl.report.comparisons import difference, outcomes
from proposer_rl.report.statistics import Estimate, mean_of
from proposer_rl.report.studies import Study
from research.claims import beyond, majority, paper_claims, within
from tests.report.folders import TASK, cycle, study_in, write_ends, write_run
from tests.report.test_outcomes import FAST, SEEDS, SLOW, curve_of, study_of

STALL = "The baseline that trains on the target alone stalls at first."
SOON = "Both Proposers learn almost at once."
FASTER = "Performance gain learns faster than the baseline."
ALIKE = "Out of distribution the methods end up alike."
SLIGHTLY = "Performance gain beats task difficulty slightly, not significantly."
HARDER = "Proposals start easy and grow harder."
GAINS = "The maximum gain of the replicas stays positive while the mean falls below zero."


def verdicts(study: Study) -> dict[str, str]:
    return {claim: evidence[0] for claim, evidence in paper_claims(study) if evidence}


def test_few_seeds_decide_no_claim(tmp_path: Path) -> None:
    study = study_of(tmp_path, 4, perf_gain=FAST, task_difficulty=FAST, target=SLOW)
    assert set(verdicts(study).values()) == {"too few seeds"}


def test_claims_that_hold_are_supported(tmp_path: Path) -> None:
    late = [0.0, 0.0, 0.0, 0.0, 0.3, 0.6]
    soon = [0.2, 0.5, 0.7, 0.85, 0.9, 0.9]
    found = verdicts(study_of(tmp_path, perf_gain=soon, task_difficulty=soon, target=late))
    for claim in (STALL, SOON, FASTER, HARDER, GAINS):
        assert found[claim] == "supported", claim
    assert found[ALIKE] == "contradicted"


def test_claims_that_fail_are_contradicted(tmp_path: Path) -> None:
    found = verdicts(study_of(tmp_path, perf_gain=SLOW, task_difficulty=SLOW, target=FAST))
    for claim in (STALL, SOON, FASTER):
        assert found[claim] == "contradicted", claim
    found = verdicts(study_of(tmp_path / "other", perf_gain=SLOW, task_difficulty=FAST))
    assert found[SLIGHTLY] == "contradicted"


def test_what_no_method_does_soon_is_not_held_against_one(tmp_path: Path) -> None:
    """Where a Solver learns from nothing at first, that it does not says nothing of a Proposer."""
    late, latest = [0.0, 0.0, 0.2, 0.5, 0.7, 0.9], [0.0, 0.0, 0.0, 0.0, 0.2, 0.9]
    curves = {"perf_gain": late, "task_difficulty": late, "target": latest}
    study = study_of(tmp_path / "nobody", **curves)
    assert verdicts(study)[STALL] == "supported" and verdicts(study)[SOON] == "undecided"
    told = dict(paper_claims(study))[SOON][1]  # type: ignore[index]
    assert "perf_gain gets to 10% within 10 updates in 0 of 6 runs" in told
    assert "in 6 after 20;" in told and told.endswith("nor does any run of any method here")
    curves["hand_designed"] = FAST
    found = verdicts(study_of(tmp_path / "somebody", **curves))
    assert found[STALL] == "supported" and found[SOON] == "contradicted"


def test_alike_is_shown_by_narrow_intervals_of_methods_that_learnt(tmp_path: Path) -> None:
    names = ("task_difficulty", "perf_gain", "target")  # the second is the best by a little
    for folder, factor, expected in (("a", 1.0, "supported"), ("b", 0.05, "undecided")):
        ends = {  # each method with small chances of its own
            name: [factor * (0.9 + 0.01 * ((s + i) * (i + 1) % 5)) for s in range(SEEDS)]
            for i, name in enumerate(names)
        }
        found = verdicts(write_ends(tmp_path / folder, ends))
        assert found[ALIKE] == expected and found[SLIGHTLY] == expected, folder


def test_a_sure_but_small_difference_does_not_refute_alike(tmp_path: Path) -> None:
    ends = {"perf_gain": (0.86, 0.002), "target": (0.9, 0.003), "task_difficulty": (0.8, 0.2)}
    places = np.array([0, 1, -1, 0.5, -0.5, 0.2])
    study = write_ends(tmp_path, {name: end + by * places for name, (end, by) in ends.items()})
    outcome = next(one for one in outcomes(study) if one.name.startswith("OOD"))
    pair = [group for label in ("target", "perf_gain") if (group := study.group(label))]
    assert difference(outcome, *pair).p < 1e-3 and within(difference(outcome, *pair), 0.1)
    assert verdicts(study)[ALIKE] == "undecided"


def test_a_method_that_is_slightly_worse_is_not_slightly_better(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name, end in (("perf_gain", 0.895), ("task_difficulty", 0.9)):
        for seed in range(SEEDS):
            curve = [0.0, end / 2, end + 0.02 * rng.normal()]
            write_run(tmp_path / f"{name}{seed}", name, [seed], curve)
    assert verdicts(study_in(tmp_path))[SLIGHTLY] == "undecided"


def test_a_correction_for_many_methods_makes_no_difference_insignificant(tmp_path: Path) -> None:
    """What is significant by itself is so however many other methods a report has."""
    seeds = np.arange(SEEDS)
    ends = {"perf_gain": 0.91 + 0.01 * seeds, "task_difficulty": 0.9 + 0.001 * seeds}
    ends |= {f"other_{i}-": 0.6 + 0.1 * ((seeds * i) % 5) for i in range(12)}
    study = write_ends(tmp_path, ends)
    verdict, text = dict(paper_claims(study))[SLIGHTLY]  # type: ignore[misc]
    assert verdict == "undecided" and "without correction" in text


def test_a_pair_without_any_spread_does_not_hide_the_others(tmp_path: Path) -> None:
    ends = {"perf_gain": [0.9] * SEEDS, "task_difficulty": [0.9] * SEEDS}
    ends["target"] = [0.3 + 0.01 * seed for seed in range(SEEDS)]
    assert verdicts(write_ends(tmp_path, ends))[ALIKE] == "contradicted"


def test_a_space_in_which_more_need_not_be_harder_has_no_such_finding(tmp_path: Path) -> None:
    task = {**TASK, "space": {"force": [1.0, 2.0], "mass": [1.0, 2.0, 3.0]}}
    for seed in range(SEEDS):
        cycles = [cycle(i, [0.1, 0.1], [[8 - i, 1, 1], [1, 1, 1 + i]]) for i in range(8)]
        write_run(tmp_path / f"p{seed}", "perf_gain", [seed], cycles=cycles, task=task)
    assert HARDER not in verdicts(study_in(tmp_path))


def test_badge_and_text_tell_the_same(tmp_path: Path) -> None:
    """A difference that is significant decides, and the text says so; else neither does."""
    for seed in range(SEEDS):
        write_run(tmp_path / f"t{seed}", "target", [seed], curve_of(SLOW, SEEDS - seed))
    curves = {"perf_gain": FAST, "task_difficulty": SLOW}
    found = dict(paper_claims(study_of(tmp_path, **curves)))
    for claim in (FASTER, SLIGHTLY):
        verdict, text = found[claim]  # type: ignore[misc]
        p = float(text.split("p = ")[1].split(" ")[0])
        assert ("the difference is significant" in text) <= (p <= 0.05)
        assert claim == SLIGHTLY or (verdict == "undecided") == (p > 0.05)


def test_two_are_alike_where_the_interval_of_90_percent_is_inside() -> None:
    estimate = Estimate(0.02, 0.03, 9)
    edge = 0.02 + 1.833113 * 0.03  # of the tables, 9 degrees of freedom at 95 %
    assert within(estimate, edge + 1e-4) and not within(estimate, edge - 1e-4)
    assert within(Estimate(-0.02, 0.03, 9), edge + 1e-4)
    assert math.isnan(beyond(mean_of([1.0]), 1.0)) and not within(mean_of([1.0]), 100)


def test_a_majority_is_that_of_the_binomial_law() -> None:
    for count in range(8):
        tail = sum(math.comb(7, k) for k in range(count, 8)) / 2**7
        assert majority(count, 7) == pytest.approx(tail)
