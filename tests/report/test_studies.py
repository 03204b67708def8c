"""What may be compared with what."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from proposer_rl.report.charts import charts
from proposer_rl.report.comparisons import primary
from proposer_rl.report.measures import COSTS
from proposer_rl.report.outcomes import comparison_table, group_table
from proposer_rl.report.page import commands, document, incomplete, report_command
from proposer_rl.report.reading import UnreadableRun
from proposer_rl.report.studies import Study, read_studies
from research.ranking import ranking, spread
from tests.report.folders import TASK, cycle, write_run

CYCLES = [cycle(0, [0.1, 0.2], [[1, 1, 1], [1, 1, 1]])]


def read(folder: Path) -> tuple[list[Study], list[str]]:
    return read_studies(sorted(folder.iterdir()), None)


def labels(study: Study) -> dict[str, list[int]]:
    return {group.label: group.seeds for group in study.groups}


def test_seeds_of_one_method_make_a_group(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "target", [1])
    write_run(tmp_path / "b", "target", [0])
    write_run(tmp_path / "c", "hand_designed", [0, 1])
    (study,), notes = read(tmp_path)
    assert labels(study) == {"target": [0, 1], "hand_designed": [0, 1]}
    assert not notes and study.title == "Tiny scale, 2×4 mazes"


def test_other_settings_make_another_group_that_is_named_by_them(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "perf_gain", cycles=CYCLES)
    write_run(tmp_path / "b", "perf_gain", cycles=CYCLES, proposer={"rollouts": 9})
    write_run(tmp_path / "c", "perf_gain", cycles=CYCLES, ablation="probes_0")
    (study,), _ = read(tmp_path)
    assert set(labels(study)) == {
        "perf_gain (rollouts=2)",
        "perf_gain (rollouts=9)",
        "perf_gain, probes_0",
    }


def test_many_differences_are_told_apart_by_numbers(tmp_path: Path) -> None:
    for i, word in enumerate(("one", "two")):
        proposer = {"some_setting": word * 9, "a": {"size": i}, "b": {"size": -i}}
        write_run(tmp_path / word, "perf_gain", cycles=CYCLES, proposer=proposer)
    (study,), _ = read(tmp_path)
    assert list(labels(study)) == ["perf_gain #1", "perf_gain #2"]
    first = study.groups[0].setting
    assert first == f'proposer.a.size=0, proposer.b.size=0, some_setting="{"one" * 9}"'


def test_a_run_that_has_only_begun_is_of_its_group(tmp_path: Path) -> None:
    """What it has recorded so far decides nothing, for it will have recorded more at the end."""
    for seed, (cycles, rollouts) in enumerate([(CYCLES, 2), ([], 2), (CYCLES, 9), ([], 9)]):
        proposer = {"rollouts": rollouts}
        write_run(tmp_path / str(seed), "mine", [seed], cycles=cycles, proposer=proposer)
    (study,), _ = read(tmp_path)
    assert labels(study) == {"mine (rollouts=2)": [0, 1], "mine (rollouts=9)": [2, 3]}


def test_proposers_that_differ_in_their_seed_make_a_group(tmp_path: Path) -> None:
    """As Solvers do; one of another life, or of another experiment, is something else."""
    for place, checkpoint, seed in [
        ("a", "lives/seed_0/lifetime_1", 5),
        ("b", "lives/seed_12/lifetime_1", 6),
        ("c", "lives/seed_12/lifetime_1", 5),  # on a Solver that has counted already
        ("d", "lives/seed_0/lifetime_2", 5),
        ("e", "3/0", 5),
        ("f", "/other/4/15", 5),
        ("g", "4/16", 6),
    ]:
        named = {"checkpoint": checkpoint, "curriculum": {"checkpoint": checkpoint}}
        write_run(tmp_path / place, "frozen_proposer", [seed], **named)
    (study,), notes = read(tmp_path)
    members = [sorted(run.folder.name for run in group.runs) for group in study.groups]
    assert sorted(members) == [["a", "b"], ["d"], ["e", "g"], ["f"]]
    assert notes == ["left out: c: the same settings and seed as a"]
    assert document([], "bin/report", notes).lower().count("left out") == 1


def test_commands_join_the_seeds_that_differ_in_nothing_else(tmp_path: Path) -> None:
    for seed, override in [(0, "cores=1"), (1, "cores=1"), (2, "cores=2")]:
        overrides = ["+method=target", f"seed={seed}", override, "compute.progress=false"]
        write_run(tmp_path / str(seed), "target", [seed], facts={"overrides": overrides})
    (study,), _ = read(tmp_path)
    assert commands(study) == [
        "bin/train -m +method=target cores=1 seed=0,1",
        "bin/train -m +method=target cores=2 seed=2",
    ]


def test_a_run_from_python_is_told_as_it_was_called(tmp_path: Path) -> None:
    settings = {"curriculum": {"temperature": 0.5}, "seed": 0, "compute": {"progress": False}}
    words = ["task=maze", "+method=plr", "+scale=smoke"]
    for seed in (0, 1):
        facts = {"overrides": words, "settings": {**settings, "seed": seed}}
        write_run(tmp_path / str(seed), "plr", [seed], facts=facts)
    (study,), _ = read(tmp_path)
    own = "settings={'curriculum': {'temperature': 0.5}}"
    assert commands(study) == [
        f"prl.train(task='maze', curriculum='plr', scale='smoke', {own}, seed=seed)  # seed=0,1"
    ]


def test_a_command_names_the_paths_that_it_was_given(tmp_path: Path) -> None:
    arguments = {"config_dir": "/home/somebody/my conf", "pythonpath": "/home/x/code:/srv/y/lib"}
    overrides = ["+method=mine", "task.file=/data/z/levels.txt"]
    write_run(tmp_path / "a", facts={"arguments": arguments, "overrides": overrides})
    (study,), _ = read(tmp_path)
    (command,) = commands(study)
    assert command == (
        "PYTHONPATH=/home/x/code:/srv/y/lib bin/train --config-dir '/home/somebody/my conf' -m "
        "+method=mine task.file=/data/z/levels.txt seed=0"
    )
    given = [Path("/data/my sweeps"), Path("results/medium")]
    made = "bin/report '/data/my sweeps' results/medium --threshold=0.5 --baseline=plr"
    assert report_command("bin/report", given, 0.5, ["plr"]) == made


def test_seeds_that_were_trained_side_by_side_are_again(tmp_path: Path) -> None:
    """In their order: on Gymnasium's tasks a seed draws other numbers alone."""
    for name, seeds in {"a": [5, 3, 4], "b": [0, 1], "c": [7]}.items():
        words = [f"seeds={seeds}" if len(seeds) > 1 else f"seed={seeds[0]}"]
        overrides = ["task=cartpole", "+method=plr", *words, "+sweep=own"]
        write_run(tmp_path / name, "plr", seeds, facts={"overrides": overrides})
    (study,), _ = read(tmp_path)
    assert commands(study) == [
        "bin/train task=cartpole +method=plr 'seeds=[0,1]'",
        "bin/train task=cartpole +method=plr 'seeds=[5,3,4]'",
        "bin/train -m task=cartpole +method=plr seed=7",
    ]


@pytest.mark.parametrize(
    "facts",
    [
        {"overrides": None},
        # As prl.train records a task, or a curriculum, of one's own.
        {"overrides": ["~task", "+method=plr"], "settings": {"seed": 0}},
        {"overrides": ["task=maze", "+scale=smoke", "seed=0"]},
    ],
)
def test_a_command_that_is_not_known_in_full_is_not_given(facts, tmp_path: Path) -> None:
    write_run(tmp_path / "a", facts=facts)
    (study,), _ = read(tmp_path)
    assert commands(study) == ["# target: the command was not recorded"]


def test_other_levels_make_another_study(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "target", [0])
    write_run(tmp_path / "b", "target", [1])
    write_run(tmp_path / "c", "target", [0], task={**TASK, "measured": 1})
    write_run(tmp_path / "d", "target", [0], scale="other")
    studies, _ = read(tmp_path)
    assert sorted(len(study.runs) for study in studies) == [1, 1, 2]
    assert len(studies[0].runs) == 2


def test_a_seed_does_not_count_twice_and_the_longer_run_stays(tmp_path: Path) -> None:
    write_run(tmp_path / "a", curve=[0.0, 0.1], finished=False)
    write_run(tmp_path / "b", curve=[0.0, 0.1, 0.2])
    (study,), notes = read(tmp_path)
    assert [run.folder.name for run in study.runs] == ["b"]
    assert len(notes) == 1 and "left out" in notes[0] and notes[0].endswith("as b")


def test_runs_are_compared_at_the_length_of_most(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "target", [0], [0.0, 0.9, 0.9])
    write_run(tmp_path / "b", "target", [1], [0.0, 0.1, 0.9])
    write_run(tmp_path / "c", "target", [2], [0.0, 0.1, 0.1, 0.1])
    write_run(tmp_path / "d", "hand_designed", [0], [0.0, 0.1], finished=False)
    (study,), _ = read(tmp_path)
    assert study.horizon == 20
    assert [group.label for group in study.compared] == ["target"]


def test_only_runs_of_full_length_count_and_only_up_to_it(tmp_path: Path) -> None:
    for seed in range(6):
        write_run(tmp_path / f"t{seed}", "target", [seed], [0.0, 0.4 + 0.01 * seed, 0.6])
        curve, ended = ([0.0, 0.5 + 0.01 * seed, 0.7], True) if seed < 3 else ([0.0, 0.9], False)
        write_run(tmp_path / f"p{seed}", "plr", [seed], curve, finished=ended, copies=100)
    write_run(tmp_path / "p6", "plr", [6], [0.0, 0.5, 0.7, 0.9, 0.9], copies=100)
    # Measured at other updates than most; in between it is linear.
    odd = write_run(tmp_path / "p7", "plr", [7], [0.0, 0.5, 0.7, 0.9], copies=100)
    metrics = odd / "metrics.csv"
    metrics.write_text(metrics.read_text().replace("\n7,20,", "\n7,15,"))
    (study,), _ = read(tmp_path)
    assert study.horizon == 20
    plr, target = (study.group(label) for label in ("plr", "target"))
    assert plr is not None and target is not None
    assert plr.seeds == [0, 1, 2, 6, 7] and all(run.updates == 20 for run in plr.runs)
    assert plr.runs[-1].at("id_success", 20) == pytest.approx(0.7 + 0.2 / 3)
    assert all(np.isnan(run.reached("id_success", 0.8)) for run in plr.runs)
    ranked = {row["method"]: row for row in ranking(study, {}).rows}
    assert ranked["plr"]["seeds"] == 5 and ranked["plr"]["frames (M)"] == pytest.approx(
        0.0062 / 1.5
    )
    assert spread(study, next(iter(COSTS))) == pytest.approx(14 / 12)  # that of the odd one
    drawn = charts(study)["outcomes"][0]["methods"]
    of_plr = [group.label for group in study.groups].index("plr")
    table = next(row for row in comparison_table(study).rows if row["first"] == "plr")
    mean = float(np.mean(primary(study).values(plr)))
    assert drawn[of_plr]["mean"] == pytest.approx([mean], rel=1e-4)
    known = [value is not None for value in drawn[of_plr]["values"]]
    assert known == [True] * 3 + [False] * 3 + [True] * 2
    other = float(np.mean(primary(study).values(target)))
    assert table["difference"].estimate == pytest.approx(mean - other)
    rows = {row["method"]: row for row in group_table(study).rows}
    assert rows["plr"]["seeds"] == "5 of 8" and rows["plr"]["reached 80%"] == "0 of 5"
    named = " ".join(incomplete(study))
    assert all(f"plr seed {seed}" in named for seed in (3, 4, 5)) and "target" not in named


def test_an_unreadable_folder_is_noted_and_the_others_are_read(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    (write_run(tmp_path / "b") / "config.json").write_text("{}")
    (study,), notes = read(tmp_path)
    assert len(study.runs) == 1 and len(notes) == 1 and "b: an entry" in notes[0]
    with pytest.raises(UnreadableRun, match="an entry"):
        read_studies([tmp_path / "b"], None)


def test_the_threshold_can_be_chosen(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    assert read_studies([tmp_path / "a"], 0.5)[0][0].threshold == 0.5
    assert read_studies([tmp_path / "a"], None)[0][0].threshold == 0.8


def test_variants_are_called_by_what_differs_on_their_command_lines(tmp_path: Path) -> None:
    """Not by what is no part of a run's outcome, nor by what all have in common."""
    common = ["+method=mine", "+scale=tiny", "solver.batch_size=8"]
    for name, words, target in (("a", [], "x"), ("b", ["+filter=learnability"], "y")):
        for seed in range(2):
            overrides = [*common, *words, f"seed={seed}", "hydra.run.dir=x", "compute.cores=1"]
            write_run(
                tmp_path / f"{name}{seed}",
                "mine",
                [seed],
                facts={"overrides": overrides},
                curriculum={"_target_": target},
            )
    (study,), _ = read_studies(sorted(tmp_path.iterdir()), None)
    assert labels(study) == {"mine": [0, 1], "mine, filter=learnability": [0, 1]}


def test_seeds_trained_together_have_one_curriculum(tmp_path: Path) -> None:
    """Its cycles would else count once for every seed, and an interval be of nothing."""
    write_run(tmp_path / "a", "plr", [0, 1], cycles=[{"updates": 0, "score": 1}])
    write_run(tmp_path / "b", "plr", [2], cycles=[{"updates": 0, "score": 2}])
    (study,), _ = read(tmp_path)
    (group,) = study.groups
    assert group.seeds == [0, 1, 2]
    assert sorted(run.folder.name for run in group.logs) == ["a", "b"]
