"""Peers beside ours: what jaxued's maze is given, who is refused, and that its process ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from proposer_rl.tasks.view_mazes.view_levels import ViewLevel
from research.benchmarks.__main__ import main
from research.benchmarks.jaxued_peer import LEAN, TRAINING, WAYS, WRAPPER
from research.benchmarks.peer import jaxued_maze, played
from research.benchmarks.results import Options
from research.benchmarks.teacher import beside_syllabus
from research.benchmarks.timing import threads
from research.benchmarks.view import MAX_STEPS, beside_jaxued, through_minigrid
from research.benchmarks.view_training import SMALL, on_these_cores
from tests.commands import call
from tests.tasks.view_mazes.oracles import random_levels

TRIED = Options(repeats=1, precision="fp32", size="tiny")
DRAWINGS = ["v#..\n.#G.", "..<#\nG...", "G#.^\n....", "...G\n.>#."]
JAXUED = os.environ.get("JAXUED_PYTHON")
real = pytest.mark.skipif(not JAXUED, reason="JAXUED_PYTHON names no interpreter that has jaxued")

READS = """
import sys
import numpy as np
from jaxued.environments.maze import Level
given = np.load(sys.argv[1])
for i, drawing in enumerate(sys.argv[2:]):
    level = Level.from_str(drawing)
    for name in ("wall_map", "goal_pos", "agent_pos", "agent_dir"):
        np.testing.assert_array_equal(given[name][i], getattr(level, name), strict=True)
"""

# Answers as benchmarks/jaxued_peer.py does, but plays nothing.
FAKE = """#!{interpreter}
import json, os, sys
print(json.dumps({{"jaxued": "0", "jax": "0", "cores": 1, "pid": os.getpid()}}), flush=True)
open({note!r}, "w").write(str(os.getpid()))
for line in sys.stdin:
    if {dies}:
        sys.exit(3)
    seconds = {{"wrapper": 0.5, "lean": 0.25, "training": 0.125}}[line.strip()]
    print(json.dumps({{"seconds": seconds, "reward": {reward}}}), flush=True)
"""


@pytest.fixture
def fake(tmp_path: Path):
    """Makes an interpreter that is none; returns its path, and the file with its process's id."""

    def make(reward: float = 0.0, dies: bool = False) -> tuple[str, Path]:
        program, note = tmp_path / "fake", tmp_path / "pid"
        text = FAKE.format(interpreter=sys.executable, note=str(note), reward=reward, dies=dies)
        program.write_text(text)
        program.chmod(0o755)
        return str(program), note

    return make


def has_ended(note: Path) -> bool:
    try:
        os.kill(int(note.read_text()), 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["view", "--jaxued", "nowhere/python"], "--jaxued nowhere/python: No such file"),
        (["view", "--jaxued", sys.executable], "No module named 'jaxued'; must be an interpreter"),
        (["view", "--jaxued", "/bin/echo"], "--jaxued /bin/echo: it does not run Python; must be"),
        (
            ["meta", "levels", "--jaxued", "p"],
            "is for the benchmark view and view_training, not for meta, levels",
        ),
        (["--jaxued", "p", "--device", "meta"], "measured on the CPU; give --device cpu, not meta"),
        (
            ["teacher", "--syllabus", sys.executable],
            "No module named 'syllabus'; must be an interp",
        ),
        (["view", "--syllabus", "p"], "is for the benchmark teacher, not for view"),
    ],
)
def test_refused_before_anything_is_measured(
    monkeypatch, capsys, tmp_path: Path, arguments: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(main, *arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(("error: --jaxued ", "error: --syllabus ")) and message in line
    assert not (tmp_path / "bench.json").exists()


def test_levels_are_given_as_jaxued_has_them() -> None:
    """Column and row of each mark in the drawing, as jaxued's ``Level.from_str`` reads it."""
    given = played(ViewLevel.from_text(DRAWINGS), torch.zeros(5, 4, dtype=torch.int64), 250)
    for i, drawing in enumerate(DRAWINGS):
        marks = {
            mark: (column, row)
            for row, line in enumerate(drawing.split("\n"))
            for column, mark in enumerate(line)
        }
        (agent,) = marks.keys() & set(">v<^")
        assert given["agent_dir"][i] == ">v<^".index(agent)
        assert tuple(given["agent_pos"][i]) == marks[agent]
        assert tuple(given["goal_pos"][i]) == marks["G"]
        walls = [[mark == "#" for mark in line] for line in drawing.split("\n")]
        assert given["wall_map"][i].tolist() == walls
    assert given["actions"].shape == (5, 4) and given["max_steps"] == 250


def test_rows_hold_the_times_of_the_process_s_own_clock(fake) -> None:
    levels = ViewLevel.from_text(DRAWINGS)
    actions = torch.randint(3, (40, 4), generator=torch.Generator().manual_seed(0))
    program, note = fake(through_minigrid(levels, actions))
    result = beside_jaxued([(levels, actions)], program, repeats=3)
    ours, *theirs = result.rows
    assert ours.samples[WRAPPER] == [0.5] * 3 and ours.samples[LEAN] == [0.25] * 3
    assert [row.value.median for row in theirs[::2]] == [320.0, 640.0]
    for row, seconds in zip(theirs[1::2], (0.5, 0.25), strict=True):
        mine = sorted(ours.samples["TorchRL"])
        expected = [seconds / time for time in reversed(mine)]
        assert [row.value.low, row.value.median, row.value.high] == pytest.approx(expected)
    assert has_ended(note)


def test_training_beside_a_peer_is_frames_by_either_one_s_clock(fake) -> None:
    program, note = fake()
    with threads(1):
        result = on_these_cores(SMALL, replace(TRIED, jaxued=program))
    ours, theirs, relative = result.rows
    settings = SMALL.config.solver
    frames = settings.batch_size * settings.ppo.horizon
    assert theirs.value.median == frames / 0.125
    assert relative.value.median == pytest.approx(0.125 / ours.samples["update"][0])
    assert "0, jax 0, on 1 core(s)" in result.notes[0] and has_ended(note)


def test_what_syllabus_says_of_its_calls_becomes_rows(tmp_path: Path) -> None:
    program = tmp_path / "fake"
    said = {"syllabus": "0", "seconds": {"one": [0.004, 0.001, 0.002], "other": [1.0]}}
    program.write_text(f"#!{sys.executable}\nprint({json.dumps(json.dumps(said))})\n")
    program.chmod(0o755)
    one, other = beside_syllabus(str(program), 16, 3)
    assert (one.value.low, one.value.median, one.value.high) == (0.001, 0.002, 0.004)
    assert "Syllabus 0, 4000 tasks, other" in other.what and other.reached is None


def test_other_rewards_end_the_comparison_and_the_process(fake) -> None:
    program, note = fake(reward=1e9)
    levels = ViewLevel.from_text(DRAWINGS)
    with pytest.raises(AssertionError, match="the environments differ"):
        beside_jaxued([(levels, torch.zeros(5, 4, dtype=torch.int64))], program, repeats=1)
    assert has_ended(note)


def test_a_process_that_ends_is_told(fake) -> None:
    program, _ = fake(dies=True)
    levels = ViewLevel.from_text(DRAWINGS)
    with (
        pytest.raises(RuntimeError, match="ended with exit code 3"),
        jaxued_maze(program, levels, torch.zeros(5, 4, dtype=torch.int64), 250) as peer,
    ):
        peer.play(WRAPPER)


@real
def test_jaxued_reads_the_same_levels(tmp_path: Path) -> None:
    levels = random_levels(8)
    np.savez(tmp_path / "given.npz", **played(levels, torch.zeros(1, 8), MAX_STEPS))
    command = [str(JAXUED), "-I", "-c", READS, str(tmp_path / "given.npz"), *levels.to_text()]
    subprocess.run(command, check=True)


@real
def test_jaxued_plays_what_minigrid_plays() -> None:
    """Over more than two episodes' time, so that goals and the step limit both end some."""
    levels = random_levels(16)
    actions = torch.randint(3, (2 * MAX_STEPS + 50, 16), generator=torch.Generator().manual_seed(0))
    expected = through_minigrid(levels, actions)
    assert expected > 1
    with threads(1), jaxued_maze(str(JAXUED), levels, actions, MAX_STEPS) as peer:
        assert peer.about.startswith("jaxued ") and peer.about.endswith(" on 1 core(s)")
        for way in WAYS:
            seconds, reward = peer.play(way)
            assert seconds > 0 and reward == pytest.approx(expected, abs=1e-3)


@real
def test_jaxued_s_training_learns_to_walk_ahead() -> None:
    """As a Solver does that is trained: more reward on levels whose goal is in sight."""
    levels = ViewLevel.from_text([">..G", ">.G."])
    settings = replace(SMALL.config.solver.ppo, learning_rate=3e-3, entropy_coeff=0.0)
    numbers = asdict(settings) | SMALL.config.task["network"]
    actions = torch.zeros(64, 2, dtype=torch.int64)
    with threads(1), jaxued_maze(str(JAXUED), levels, actions, 12, numbers) as peer:
        rewards = [peer.play(TRAINING)[1] for _ in range(60)]
    assert sum(rewards[-5:]) > 2 * sum(rewards[:5])
