"""Pages of the docs that are drawn from runs: which curriculum to use, and which claims hold."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import integrate, stats

from proposer_rl.cli.help import needs
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.studies import Study, read_studies
from proposer_rl.report.style import Drawing
from proposer_rl.report.tables import escape_markdown
from research.claims import own_claims
from research.generalisation import (
    Score,
    check_names,
    generalisation_table,
    read_scores,
    write_scores,
)
from research.pages import CHOICE, CLAIMS, difficulty, main
from research.ranking import EXACT, STEADY, budgets, choices, needs_of
from research.timing import read_timing, timed
from tests.report.folders import TASK, cycle, write_rockets, write_run, write_seconds

NEEDS = needs([CONFIG_FOLDER])
NOTHING = "no target, episodes alone"
SEEDS = 5
FLAT, SLOW = [0.0] * 6, [0.0, 0.0, 0.05, 0.3, 0.5, 0.6]
FAST, FASTEST = [0.0, 0.4, 0.7, 0.85, 0.9, 0.9], [0.0, 0.8, 0.9, 0.95, 0.95, 0.95]


def write_methods(
    folder: Path, curves: Mapping[str, Sequence[float]], seeds: int = SEEDS, **facts: str
) -> Path:
    """Seeds of each method; ``perf_gain`` spends twelve times the frames of the others."""
    harder = [cycle(i, [0.1, 0.2], [[8 - i, 1, 1], [1, 1, 1 + i]], every=6) for i in range(8)]
    for label, base in curves.items():
        method, _, ablation = label.partition(", ")
        proposes = method == "perf_gain"
        for seed in range(seeds):
            write_run(
                folder / f"{label}_{seed}",
                method,
                [seed],
                [value * (1 - 0.01 * seed) for value in base],
                cycles=harder if proposes else (),
                copies=1100 if proposes else 0,
                asked=3 if EXACT in NEEDS.get(method, ()) or ablation == "filtered" else 0,
                ablation=ablation or "none",
                facts={"about": facts} if facts else None,
            )
    return folder


def study_of(folder: Path) -> Study:
    return read_studies(sorted(folder.iterdir()), None)[0][0]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    curves = {
        "perf_gain": FASTEST,
        "ncc": FAST,
        "hand_designed": FASTEST,
        "domain_randomization": SLOW,
        "target": FLAT,
    }
    return write_methods(tmp_path_factory.mktemp("runs"), curves)


@pytest.fixture(scope="module")
def pages(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs") / "findings"
    main([str(runs), "-o", str(folder)])
    return folder


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages name their pictures, which takes most of the time to draw."""

    def named(drawing: Drawing, files: object) -> str:
        return f"![{escape_markdown(drawing.title)}](figures/{drawing.name}.png)"

    monkeypatch.setattr("research.pages._picture", named)


def test_the_best_depends_on_what_there_is_and_on_what_is_scarce(runs: Path) -> None:
    """A schedule nobody has here: that method is not chosen."""
    best = {
        there: [choice.best.label if choice else None for choice in row.values()]
        for there, row in choices(study_of(runs), NEEDS).items()
    }
    assert best == {
        "a known target, exact evaluation": ["perf_gain", "ncc", "perf_gain"],
        "a known target, episodes alone": ["domain_randomization"] * 3,
        "no target, exact evaluation": ["ncc"] * 3,
        "no target, episodes alone": ["domain_randomization"] * 3,
    }


def test_the_mean_over_a_budget_is_the_area_under_the_curve_up_to_it(runs: Path) -> None:
    study = study_of(runs)
    updates, frames, seconds = budgets(study).values()
    assert frames.name == "ID success, mean over 0.005 million frames, the curriculum's too"
    assert seconds.name == "ID success, mean over 10 seconds"
    for group in study.groups:
        for run in group.runs:
            y, x = run.metrics["id_success"], run.metrics["updates"]
            for outcome in (updates, seconds):
                assert outcome.value(run) == pytest.approx(integrate.trapezoid(y, x) / 50)
            spent = x * (1200 if group.label == "perf_gain" else 100)
            fine = np.linspace(0, 5000, 100_001)
            expected = integrate.trapezoid(np.interp(fine, spent, y), fine) / 5000
            assert frames.value(run) == pytest.approx(expected, rel=1e-6)


def test_methods_that_cannot_be_told_apart_are_named(tmp_path: Path) -> None:
    for method, ends in {"plr": (0.6, 0.02), "accel": (0.7, -0.02), "target": (0, 0)}.items():
        for seed in range(SEEDS):
            end = ends[0] + ends[1] * seed
            write_run(tmp_path / f"{method}{seed}", method, [seed], [0.0, end / 2, end], asked=0)
    choice = choices(study_of(tmp_path), NEEDS)["a known target, episodes alone"]["updates"]
    assert choice is not None and choice.others == 2
    assert {choice.best.label, *choice.level} == {"plr", "accel"}
    assert "no significant difference to" in choice.text()


@pytest.mark.parametrize(
    ("curves", "seeds", "doubt"),
    [
        ({"plr": FAST, "accel": SLOW}, 4, "it takes 5 seeds of each to decide"),
        ({"plr": [0.0, 0.05, 0.05], "accel": FLAT[:3]}, 6, "it is not shown to have learnt"),
    ],
)
def test_thin_evidence_chooses_nothing(curves, seeds: int, doubt: str, tmp_path: Path) -> None:
    found = choices(study_of(write_methods(tmp_path, curves, seeds)), NEEDS)
    choice = found["no target, episodes alone"]["updates"]
    assert choice is not None and choice.best.label == "plr" and choice.doubt == doubt
    assert ("[" in choice.value) == (seeds >= 5)


@pytest.mark.usefixtures("undrawn")
def test_a_method_with_few_seeds_is_not_chosen_and_hinders_none(tmp_path: Path) -> None:
    write_methods(tmp_path / "runs", {"plr": FASTEST}, seeds=2)
    write_methods(tmp_path / "runs", {"accel": SLOW, "robust_plr": FAST})
    choice = choices(study_of(tmp_path / "runs"), NEEDS)["no target, episodes alone"]["updates"]
    assert choice is not None and choice.best.label == "robust_plr" and not choice.doubt
    assert choice.others == 1
    main([str(tmp_path / "runs"), "-o", str(tmp_path / "pages")])
    text = (tmp_path / "pages" / CHOICE).read_text(encoding="utf-8")
    assert "Not chosen from for want of 5 seeds: plr." in text


@pytest.mark.parametrize("longer", [1.4, 1.6])
def test_seconds_decide_nothing_where_the_machine_did_other_things(
    longer: float, tmp_path: Path
) -> None:
    write_methods(tmp_path, {"plr": FAST, "accel": SLOW})
    file = tmp_path / "accel_2" / "metrics.csv"
    table = pd.read_csv(file)
    table["seconds"] *= longer
    table.to_csv(file, index=False)
    found = choices(study_of(tmp_path), NEEDS)["no target, episodes alone"]
    doubts = [choice.doubt for choice in found.values() if choice]
    assert doubts[:2] == ["", ""]
    assert bool(doubts[2]) == (longer > STEADY)
    assert doubts[2] in ("", "what runs of one method took differs by up to 1.6 times")


def test_what_a_method_needs_is_what_its_runs_say(tmp_path: Path) -> None:
    """Else what its file says; of whose needs nobody knows is not chosen."""
    write_methods(tmp_path, {"plr": FAST}, needs="a target, a moon")
    write_methods(tmp_path, {"mine": FASTEST, "accel": SLOW})
    found = choices(study_of(tmp_path), NEEDS)
    best = {choice.best.label for row in found.values() for choice in row.values() if choice}
    assert best == {"accel"}
    write_methods(tmp_path / "own", {"mine": FASTEST, "accel": SLOW}, needs="")
    found = choices(study_of(tmp_path / "own"), NEEDS)
    assert found["no target, episodes alone"]["updates"].best.label == "mine"  # type: ignore


def test_a_variant_needs_what_its_runs_asked_for(tmp_path: Path) -> None:
    """With a choice by exact success even domain randomization needs that."""
    curves = {"domain_randomization": SLOW, "domain_randomization, filtered": FASTEST}
    found = choices(study_of(write_methods(tmp_path, curves)), NEEDS)
    best = {there: row["updates"].best.label for there, row in found.items() if row["updates"]}
    assert best["no target, exact evaluation"] == "domain_randomization, filtered"
    assert best["no target, episodes alone"] == "domain_randomization"


def verdicts(study: Study) -> list[str]:
    return [evidence[0] if evidence else "" for _, evidence in own_claims(study, NEEDS)]


def test_our_claims_hold_where_they_are_true(tmp_path: Path) -> None:
    true = {
        "first_order_gain": FASTEST,
        "first_order_proposer": FAST,
        "hand_designed": FAST,
        "domain_randomization": SLOW,
        "perf_gain, paper_literal": [value * 0.9 for value in SLOW],
        "target": FLAT,
    }
    study = study_of(write_methods(tmp_path / "true", true))
    assert verdicts(study) == ["supported"] * 3
    few = [replace(group, runs=group.runs[1:]) for group in study.groups]
    assert verdicts(replace(study, groups=tuple(few))) == ["too few seeds"] * 3
    one = [group for group in study.groups if group.label == "first_order_gain"]
    assert verdicts(replace(study, groups=tuple(one))) == [""] * 3
    false = {**true, "first_order_gain": SLOW, "first_order_proposer": FLAT, "ncc": FAST}
    assert verdicts(study_of(write_methods(tmp_path / "false", false))) == ["contradicted"] * 3
    nothing = {label: [value / 20 for value in curve] for label, curve in true.items()}
    study = study_of(write_methods(tmp_path / "nothing", nothing))
    assert "supported" not in verdicts(study)


def test_the_pages_say_what_was_found(pages: Path) -> None:
    text = (pages / CHOICE).read_text(encoding="utf-8")
    assert "| **perf\\_gain** 0." in text and "better than all others (" in text
    assert "hand\\_designed (a schedule, a target)" in text
    claims = (pages / CLAIMS).read_text(encoding="utf-8")
    ours = claims.partition("## Our claims")[2]
    assert claims.count("**Supported**") and ours.count("**Not tested**") == 3
    for page in (text, claims):
        for picture in re.findall(r"!\[[^]]+\]\((.*)\)", page):
            assert (pages / picture).is_file()


def test_other_levels_are_told_by_method(runs: Path, tmp_path: Path) -> None:
    """A mean over the seeds of each; a score of other updates is none of the end."""
    scores = [
        Score(folder.name, int(folder.name[-1]), updates, "big, new", 7, 0.1 * rank, math.nan, "a1")
        for rank, folder in enumerate(sorted(runs.glob("ncc_*")), 1)
        for updates in (50, 40)
    ]
    (tmp_path / "scores.csv").write_bytes(write_scores(scores))
    for read, score in zip(read_scores(tmp_path / "scores.csv"), scores, strict=True):
        assert read[:5] == score[:5] and read.digest == score.digest
        assert read[5:7] == pytest.approx(score[5:7], nan_ok=True)
    found = generalisation_table(study_of(runs), read_scores(tmp_path / "scores.csv"))
    of = {row["method"]: row for row in found.rows}
    assert of["ncc"]["big, new"].estimate == pytest.approx(0.3)  # type: ignore[union-attr]
    assert of["target"]["big, new"] is None
    worst = of["ncc"]["OOD success on the worst 10 %"].estimate  # type: ignore[union-attr]
    assert worst == pytest.approx(0.45 * np.mean([1 - 0.01 * seed for seed in range(SEEDS)]))


def test_seconds_can_be_those_of_methods_timed_in_turns(tmp_path: Path) -> None:
    """Whatever the runs took: half as good at a fifth of the time is better by seconds."""
    write_methods(tmp_path / "runs", {"plr": FAST, "accel": [value / 2 for value in FASTEST]})
    table = pd.read_csv(slow := tmp_path / "runs" / "accel_2" / "metrics.csv")
    table["seconds"] *= 9
    table.to_csv(slow, index=False)
    times = {"plr": [4.0, 5.0, 60.0], "accel": [1.0, 6.0, 0.5]}
    file = write_seconds(tmp_path / "seconds.json", times)
    study, *_ = timed(study_of(tmp_path / "runs"), read_timing([file]))
    for run in study.runs:
        medians = {"plr": 5.0, "accel": 1.0}
        assert run.own_seconds.tolist() == [
            medians[run.method] * updates for updates in run.metrics["updates"]
        ]
    best = [choice and choice.best.label for choice in choices(study, NEEDS)[NOTHING].values()]
    assert best[::2] == ["plr", "accel"]


@pytest.mark.parametrize(
    ("accel", "robust_plr", "level"),
    [
        ([2.0, 1.5, 2.5], [3.0, 3.0, 2.0], []),
        ([2.0, 1.0, 2.5], [3.0, 3.0, 2.0], ["accel"]),
        ([2.0, 1.5, 2.5], [3.0, 0.3, 2.0], ["robust_plr"]),
        ([0.4, 1.5, 2.5], [3.0, 3.0, 1.0], ["accel", "robust_plr"]),
        ([2.0], [3.0], []),
    ],
    ids=["different in all", "but in one", "reversed in one", "each in another", "only one"],
)
def test_by_seconds_better_is_who_is_so_in_every_round(
    accel: list[float], robust_plr: list[float], level: list[str], tmp_path: Path
) -> None:
    """Methods that learn alike but for noise, so that their seconds decide."""
    times = {"plr": [1.0] * len(accel), "accel": accel, "robust_plr": robust_plr}
    rng = np.random.default_rng(0)
    curves = {name: np.array(FAST) * (1 + 0.02 * rng.standard_normal((6, 1))) for name in times}
    for name, rows in curves.items():
        for seed, row in enumerate(rows):
            write_run(tmp_path / "runs" / f"{name}_{seed}", name, [seed], row.tolist(), asked=0)
    file = write_seconds(tmp_path / "seconds.json", times)
    study, *rounds = timed(study_of(tmp_path / "runs"), read_timing([file]))
    *others, found = filter(None, choices(study, NEEDS, rounds)[NOTHING].values())
    *before, medians = filter(None, choices(study, NEEDS)[NOTHING].values())
    assert (found.best.label, found.value, found.level) == ("plr", medians.value, level)
    assert medians.level == []  # they alone would say more
    assert [choice.text() for choice in others] == [choice.text() for choice in before]

    beaten = dict.fromkeys(("accel", "robust_plr"), True)
    at = np.arange(0, 60, 10)
    for number in range(len(accel)):
        fine = np.linspace(0, 50 * min(each[number] for each in times.values()), 10_001)
        means = {
            name: [np.interp(fine, at * times[name][number], row).mean() for row in rows]
            for name, rows in curves.items()
        }
        for name in beaten:
            test = stats.ttest_rel(means["plr"], means[name])
            assert test.pvalue < 0.05 / 3 or test.pvalue > 0.05  # either way for Holm, too
            beaten[name] &= bool(test.statistic > 0 and test.pvalue < 0.05)
    assert [name for name, always in beaten.items() if not always] == level


@pytest.mark.usefixtures("undrawn")
def test_further_methods_are_timed_beside_some_of_the_others(tmp_path: Path) -> None:
    """On a machine that is twice as fast for one of them, and four times for another."""
    first = write_seconds(tmp_path / "first.json", {"plr": [4.0], "accel": [2.0], "sfl": [3.0]})
    later = write_seconds(tmp_path / "later.json", {"plr": [2.0], "accel": [0.5], "ncc": [1.0]})
    seconds, rounds, machine = read_timing([first, later])
    assert seconds == {"plr": 4.0, "accel": 2.0, "sfl": 3.0, "ncc": 3.0}
    assert rounds == [seconds]
    assert machine == "abacus, threads: 3; ncc beside plr, accel on abacus, threads: 3"
    write_methods(tmp_path / "runs", {"plr": FAST, "ncc": SLOW})
    files = [str(first), str(later)]
    main([str(tmp_path / "runs"), "--seconds", *files, "-o", str(tmp_path / "pages")])
    text = (tmp_path / "pages" / CHOICE).read_text(encoding="utf-8")
    assert f"--seconds {first} {later} -o {tmp_path / 'pages'}" in text
    with pytest.raises(UnreadableRun, match=r"other.json: has methods .* beside none of: plr"):
        read_timing([first, write_seconds(tmp_path / "other.json", {"ncc": [1.0]})])


@pytest.mark.parametrize(
    ("plr", "beside", "ncc", "median", "rounds"),
    [
        ([4.0, 2.0, 3.0], [1.0, 2.0, 4.0], [1.0, 3.0, 2.0], 3.0, [4.0, 3.0, 1.5]),
        ([4.0, 2.0, 3.0], [2.0], [1.0], 1.5, [2.0, 1.0, 1.5]),
        ([4.0, 2.0], [1.0, 2.0, 4.0], [1.0, 1.0, 1.0], 1.5, [4.0, 1.0, 1.0]),
    ],
    ids=["as many", "fewer", "more"],
)
def test_rounds_of_several_files_go_together_in_their_order(
    plr: list[float],
    beside: list[float],
    ncc: list[float],
    median: float,
    rounds: list[float],
    tmp_path: Path,
) -> None:
    """In each a method takes its share of what the one beside it took in the same round."""
    first = write_seconds(tmp_path / "first.json", {"plr": plr})
    later = write_seconds(tmp_path / "later.json", {"plr": beside, "ncc": ncc})
    timing = read_timing([first, later])
    assert timing.seconds == {"plr": np.median(plr), "ncc": median}
    assert [each["ncc"] for each in timing.rounds] == rounds
    assert [each["plr"] for each in timing.rounds] == (plr * 2)[: len(rounds)]


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ({"plr": [1.0]}, "--seconds: has none of 'accel', but of: plr"),
        ({"plr": [1.0, 2.0, 0.0], "accel": [1.0] * 3}, "holds no seconds of methods"),
        ({"plr": [1.0, 2.0], "accel": [1.0]}, "holds no seconds of methods"),
        (None, "holds no seconds of methods"),
    ],
)
def test_wrong_seconds_get_one_line(times, message: str, tmp_path: Path, capsys) -> None:
    write_methods(tmp_path / "runs", {"plr": FAST, "accel": SLOW}, seeds=1)
    file = write_seconds(tmp_path / "seconds.json", times or {})
    if times is None:
        file.write_text("seconds")
    with pytest.raises(SystemExit) as end:
        main([str(tmp_path / "runs"), "-o", str(tmp_path / "pages"), "--seconds", str(file)])
    assert end.value.code == 2 and not (tmp_path / "pages").exists()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and message in line


def test_runs_that_were_not_measured_alike_are_refused(runs: Path, tmp_path: Path, capsys) -> None:
    write_rockets(tmp_path / "rockets", "target", 0)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.md").write_text("mine")
    wrong = {
        "were not measured alike": [str(tmp_path / "rockets"), str(runs), "-o", "new"],
        f"and has no {CHOICE}": [str(runs), "-o", str(tmp_path / "mine")],
    }
    for message, arguments in wrong.items():
        with pytest.raises(SystemExit) as end:
            main(arguments)
        assert end.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ") and message in line


def test_two_runs_of_one_name_are_not_taken_for_one(tmp_path: Path) -> None:
    for method in ("target", "plr"):
        write_run(tmp_path / method / "lifetime_0", method)
    (study,), _ = read_studies(sorted(tmp_path.glob("*/*")), None)
    with pytest.raises(UnreadableRun, match="scores could not tell it from"):
        check_names(study.runs)


def test_performance_that_is_played_is_no_exact_evaluation(tmp_path: Path) -> None:
    for exact in (True, False):
        task = {**TASK, "exact": exact}
        write_run(tmp_path / str(exact), "mine", task=task)
        (study,), _ = read_studies([tmp_path / str(exact)], None)
        assert (EXACT in needs_of(study.groups[0], {})) == exact


def test_a_legend_has_the_methods_that_are_drawn(tmp_path: Path) -> None:
    """Not those whose runs keep no levels, or no table of what the Solver trained on."""
    write_run(tmp_path / "full", "target", levels=[0.5])
    write_run(tmp_path / "bare", "plr")
    (tmp_path / "bare" / "training.csv").unlink()
    study = read_studies([tmp_path / "full", tmp_path / "bare"], None)[0][0]
    assert set(study.legend) == {"target", "plr"}
    drawing = difficulty(study)
    assert drawing is not None and drawing.legend == {"target": study.legend["target"]}
