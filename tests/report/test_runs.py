"""What is read from folders, and what is refused."""

from __future__ import annotations

import itertools
import json
import lzma
import os
from pathlib import Path

import numpy as np
import pytest

from proposer_rl.report.publish import publish
from proposer_rl.report.reading import UnreadableRun, begun, find_runs, read_run
from proposer_rl.report.runs import share_map
from research.claims import axis_means
from tests.report.folders import TASK, cycle, write_run


def test_a_run_is_read_as_it_was_written(tmp_path: Path) -> None:
    cycles = [cycle(0, [0.1, -0.2], [[1, 2, 3], [4, 5, 6]])]
    (run,) = read_run(
        write_run(tmp_path / "a", "perf_gain", [3], [0.0, 0.5, 0.9], cycles=cycles, copies=600)
    )
    assert (run.method, run.seed, run.updates, run.planned) == ("perf_gain", 3, 20, 20)
    assert run.finished and run.cycles == cycles
    assert run.metrics["id_success"].tolist() == [0.0, 0.5, 0.9]
    assert run.total_frames.tolist() == [0, 7000, 14000]
    assert run.reached("id_success", 0.5) == 10 and np.isnan(run.reached("id_success", 0.95))
    waited = [run.waited("id_success", level, 20) for level in (0.5, 0.95)]
    assert waited == [10, 20] and run.waited("id_success", 0.9, 15) == 15
    assert np.isnan(run.waited("id_success", 0.5, 30))
    assert run.at("id_success", 10) == 0.5 and np.isnan(run.at("id_success", 11))
    # Trapezoids of width 10: (0 + 0.5) / 2 and (0.5 + 0.9) / 2.
    assert run.mean_until("id_success", 20) == pytest.approx((0.25 + 0.7) / 2)
    assert np.isnan(run.mean_until("id_success", 30))


def test_a_mean_in_float32_reaches_what_it_is(tmp_path: Path) -> None:
    solved = float(np.mean([1] * 18 + [0] * 2, dtype=np.float32))
    assert solved < 18 / 20
    (run,) = read_run(write_run(tmp_path / "a", curve=[0.0, 0.5, solved]))
    assert run.reached("id_success", 18 / 20) == 20 and np.isnan(run.reached("id_success", 0.9001))


def test_seeds_trained_together_share_the_time(tmp_path: Path) -> None:
    found = read_run(write_run(tmp_path / "a", seeds=[4, 7]))
    assert [run.seed for run in found] == [4, 7]
    assert [run.shared_by for run in found] == [2, 2]
    assert found[0].own_seconds.tolist() == [0, 1, 2]
    assert found[0].metrics["updates"].tolist() == [0, 10, 20]


def test_an_unfinished_run_counts_as_far_as_it_got(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a", finished=False)
    with open(folder / "metrics.csv", "ab") as file:
        file.write(b"0,30,30")  # a row that is being written
    (run,) = read_run(folder)
    assert not run.finished and run.updates == 20


def test_a_run_made_longer_is_unfinished_until_its_new_end(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a")
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").write_text(json.dumps({**summary, "updates": 10}))
    assert not read_run(folder)[0].finished


def test_runs_are_found_at_any_depth_once_and_not_through_links(tmp_path: Path) -> None:
    one, two = write_run(tmp_path / "a/b/c/d/e/f/one"), write_run(tmp_path / "two")
    elsewhere = write_run(tmp_path.parent / f"{tmp_path.name}_elsewhere" / "run")
    os.symlink(elsewhere, tmp_path / "link")
    assert find_runs([tmp_path, two]) == sorted([one.resolve(), two.resolve()])


def test_runs_of_a_sweep_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 0, 11, 1):
        write_run(tmp_path / f"{number}_plr", seeds=[number])
    ordered = [f"{number}_plr" for number in (0, 1, 2, 10, 11)]
    assert [path.name for path in find_runs([tmp_path])] == ordered
    assert [path.name for path in begun(tmp_path)] == ordered


def replaced(old: str, new: str):
    return lambda text: text.replace(old, new)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("config.json", lambda text: text[:-5], "Unterminated string"),
        ("config.json", replaced('"schedule"', '"s"'), "'schedule' is missing"),
        ("run.json", lambda text: "[]", "run.json: Input should be a valid dictionary"),
        ("run.json", lambda text: "{}", "'task' is missing"),
        ("run.json", replaced('"title"', '"t"'), "run.json: task: title: Field required"),
        ("metrics.csv", replaced("0.5", "nan"), "id_success is not always a number"),
        ("metrics.csv", replaced("0.5", "1e300"), "id_success is not always a number"),
        ("metrics.csv", replaced("id_success", "x"), "id_success is not always a number"),
        ("metrics.csv", replaced("0.5", "half"), "metrics.csv, line 3: could not convert string"),
        ("metrics.csv", lambda text: text + text.splitlines()[1] + "\n", "must increase"),
        ("curriculum.jsonl", replaced('"seed": 0', '"seed": "0"'), "0.seed: Input should be a"),
    ],
)
def test_a_folder_that_cannot_be_read_is_named_in_one_line(
    name: str, change, message: str, tmp_path: Path
) -> None:
    cycles = [cycle(0, [0.1, 0.1], [[1], [1]])]
    folder = write_run(tmp_path / "run", cycles=cycles, levels=[0.5])
    (folder / name).write_text(change((folder / name).read_text()))
    with pytest.raises(UnreadableRun) as refused:
        read_run(folder)
    assert message in str(refused.value) and "\n" not in str(refused.value)
    assert str(refused.value).startswith(f"{folder}: ")


@pytest.mark.parametrize(
    ("table", "text", "message"),
    [
        ("runs", "run,config\na,{}\n", "an entry 'facts' is missing"),
        ("metrics", "run,seed,updates\ntarget_0,0,many\n", "could not convert"),
        ("cycles", "run,updates\ntarget_0,nothing\n", "Expecting value"),
        ("levels", None, "Input format not supported"),
    ],
)
def test_a_study_that_cannot_be_read_is_named_in_one_line(
    table: str, text: str | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("proposer_rl.report.publish.write_page", lambda *_: None)  # its figures
    publish([write_run(tmp_path / "target_0", levels=[0.5])], light := tmp_path / "light")
    packed = b"no xz" if text is None else lzma.compress(text.encode())
    (light / f"{table}.csv.xz").write_bytes(packed)
    with pytest.raises(UnreadableRun, match=message) as refused:
        read_run(light)
    assert len(str(refused.value).splitlines()) == 1 and TASK["title"] not in str(refused.value)


@pytest.mark.parametrize("name", ["config.json", "run.json", "summary.json"])
def test_the_mark_and_line_ends_of_windows_are_read(name: str, tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    (before,) = read_run(folder)
    text = (folder / name).read_bytes().replace(b"\n", b"\r\n")
    (folder / name).write_bytes(b"\xef\xbb\xbf" + text)
    (after,) = read_run(folder)
    assert (after.config, after.facts, after.finished) == (before.config, before.facts, True)


def test_what_is_told_of_single_levels_is_each_seeds_own(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", seeds=[3, 4], levels=[0.25, 1.0000001])
    with open(folder / "levels.jsonl", "a") as file:
        for updates, results in ((10, [0.9, 0.9]), (20, [0.5, 0.5])):
            row = {"seed": 4, "updates": updates, "distribution": "id", "success": results}
            file.write(json.dumps({**row, "anything": [None]}) + "\n")
    one, other = read_run(folder)
    assert {name: row.tolist() for name, row in one.levels.items()} == {
        "id_success": [0.25, 1],
        "ood_success": [0.25, 1],
    }
    assert other.levels["id_success"].tolist() == [0.5, 0.5]  # the last row at the end
    assert not read_run(write_run(tmp_path / "older"))[0].levels


def test_a_share_is_never_more_than_all(tmp_path: Path) -> None:
    """What float32 sums to 1.0000001 is 1; a success of 1.1 is left to be seen."""
    (run,) = read_run(write_run(tmp_path / "run", curve=[-1e-7, 1.0000001, 1.1]))
    assert run.metrics["id_success"].tolist() == [0, 1, 1.1]


def test_proposals_are_counted_along_every_axis(tmp_path: Path) -> None:
    """The map is the sum over the third axis and the fourth; means are over all."""
    space = {"a": [0, 1], "b": [1, 2, 4], "c": [5, 7], "d": [9]}
    counts = np.random.default_rng(0).integers(0, 9, (2, 3, 2, 1))
    cycles = [{"updates": 0, "histogram": counts.tolist()}]
    (run,) = read_run(write_run(tmp_path / "a", cycles=cycles, task={**TASK, "space": space}))
    shares = run.shares(run.cycles[0])
    assert shares is not None
    assert share_map(shares) == pytest.approx(counts[..., 0].sum(2) / counts.sum())
    drawn = [
        values
        for place, values in zip(
            np.ndindex(2, 3, 2, 1), itertools.product(*space.values()), strict=True
        )
        for _ in range(counts[place])
    ]
    assert axis_means(run, run.cycles[0]) == pytest.approx(np.mean(drawn, 0))
    assert run.shares({"histogram": counts[:1].tolist()}) is None
    assert run.shares({"histogram": (0 * counts).tolist()}) is None
    assert run.shares({"histogram": (-counts).tolist()}) is None
    assert share_map(np.array([0.25, 0.75])).tolist() == [[0.25, 0.75]]
