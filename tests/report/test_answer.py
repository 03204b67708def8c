"""What a reader is told first, from runs whose outcome is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from proposer_rl.report.comparisons import UNDECIDED
from proposer_rl.report.outcomes import answer, comparison_table, meaning
from proposer_rl.report.studies import Study, read_studies
from tests.report.folders import write_run

NOISE = np.random.default_rng(1).normal(0, 1, (8, 6))


def study_of(folder: Path, ends: Mapping[str, float], seeds: int = 6, noise: float = 0.01) -> Study:
    """Methods whose mean along training is about half of their end."""
    for number, (method, end) in enumerate(ends.items()):
        for seed in range(seeds):
            reached = end + noise * NOISE[number, seed]
            curve = [0.0, reached / 2, reached]
            write_run(folder / f"{method}{seed}", method, [seed], curve)
    (study,), _ = read_studies(sorted(folder.iterdir()), None)
    return study


def told(folder: Path, ends: Mapping[str, float], seeds: int = 6) -> Sequence[str]:
    sentences = answer(study_of(folder, ends, seeds))
    assert all(sentence.endswith(".") for sentence in sentences)
    return sentences


def test_the_best_is_named_with_how_sure_that_is(tmp_path: Path) -> None:
    ends = {"ours": 0.9, "domain_randomization": 0.5, "worse": 0.2}
    first, second = told(tmp_path / "all", ends)
    assert first.startswith(
        "Of 3 methods, ours has the highest ID success, mean over 20 updates and over seeds "
        "(median over seeds: 0.4"
    )
    assert first.endswith("it is significantly better than all others.")
    assert second == (
        "ours is significantly better than the baseline, domain_randomization; "
        "worse is significantly worse."
    )
    first, second = told(tmp_path / "some", {"twin": 0.9, **ends})
    assert "better than 2 of the 3 others, with no significant difference to " in first
    assert second.startswith(("twin and ours are signif", "ours and twin are signif"))


def test_what_is_undecided_is_said_to_be(tmp_path: Path) -> None:
    first, second = told(tmp_path, {"ours": 0.5, "domain_randomization": 0.5})
    assert first.endswith("but there is no significant difference to any of the others.")
    assert second == (
        "No method is significantly better than the baseline, domain_randomization; "
        "no significant difference for 1."
    )


def test_what_has_hardly_learnt_is_not_said_to_be_level(tmp_path: Path) -> None:
    ends = {"ours": 0.09, "domain_randomization": 0.01, "twin": 0.01}
    study = study_of(tmp_path, ends, noise=0.001)
    verdicts = [row["verdict"] for row in comparison_table(study).rows]
    assert verdicts.count("nothing learnt") == 2 and verdicts.count(UNDECIDED) == 1
    first, second = answer(study)
    assert first.endswith("but it is not shown to have learnt.") and "significant" not in first
    assert second == (
        "No method is significantly better than the baseline, domain_randomization; "
        "for 1 the better one is not shown to have learnt; no significant difference for 1."
    )


def test_the_highest_is_so_by_the_mean_and_says_it(tmp_path: Path) -> None:
    means = {"risky": [0.3, 0.31, 0.32, 0.95, 0.96], "steady": [0.5, 0.51, 0.52, 0.53, 0.54]}
    for method, curves in means.items():
        for seed, value in enumerate(curves):
            write_run(tmp_path / f"{method}{seed}", method, [seed], [value] * 3)
    assert np.mean(means["risky"]) > np.mean(means["steady"])
    (study,), _ = read_studies(sorted(tmp_path.iterdir()), None)
    assert answer(study)[0].startswith(
        "Of 2 methods, risky has the highest ID success, mean over 20 updates and over seeds "
        "(median over seeds: 0.320 "
    )


def test_few_seeds_decide_nothing(tmp_path: Path) -> None:
    first, second = told(tmp_path, {"ours": 0.9, "domain_randomization": 0.1}, seeds=4)
    assert "significant" not in first and "it takes 5 seeds" in first
    assert "Too few seeds" in second


def test_a_method_alone_is_compared_with_nothing(tmp_path: Path) -> None:
    first, second = told(tmp_path, {"ours": 0.9})
    assert first.startswith("ours is the only method here") and "Nothing is compared" in second
    write_run(tmp_path / "shorter", "plr", curve=[0.0, 0.1])
    (study,), _ = read_studies(sorted(tmp_path.iterdir()), None)
    assert answer(study)[0].startswith("ours is the only method with runs of 20 updates")


def test_what_a_method_does_is_what_its_run_recorded(tmp_path: Path) -> None:
    about = {"about": {"method": "Mine.", "ablation": "Half."}}
    write_run(tmp_path / "a", "mine", facts=about, ablation="less")
    write_run(tmp_path / "b", "target")
    write_run(tmp_path / "c", "unheard")
    (study,), _ = read_studies(sorted(tmp_path.iterdir()), None)
    known = {"method": {"target": "No curriculum.", "mine": "Not this."}}
    found = {group.label: meaning(group, known) for group in study.groups}
    assert found == {
        "mine, less": "Mine. Changed here: Half.",
        "target": "No curriculum.",
        "unheard": "Its runs do not say what it does.",
    }
