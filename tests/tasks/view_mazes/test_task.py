"""The field's maze as a task: beyond the contract's own tests, and from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from proposer_rl.cli.eval import main as evaluate
from proposer_rl.cli.train import main as train
from proposer_rl.runs.folder import read_csv
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes.generation import edit_levels
from proposer_rl.tasks.mazes.levels import validate_levels
from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv
from proposer_rl.tasks.view_mazes.view_levels import ViewLevel
from tests.commands import call
from tests.tiny import composed, tiny_view_task

SMOKE = ["task=view_maze_smoke", "compute.progress=false"]


def run(folder: Path, *words: str) -> int:
    """Calls bin/train at the smallest size; returns its exit code."""
    return call(train, *SMOKE, *words, f"hydra.run.dir={folder}")


def test_the_fields_numbers_are_the_default() -> None:
    config = composed("+method=plr", "task=view_maze", "+as=jaxued")
    ppo, maze = config.solver.ppo, config.task["maze"]
    assert (maze["height"], maze["width"], maze["max_steps"]) == (13, 13, 250)
    assert (config.solver.batch_size, ppo.horizon, ppo.epochs) == (32, 256, 5)
    assert (ppo.gamma, ppo.lmbda, ppo.learning_rate) == (0.995, 0.95, 1e-4)
    assert config.task["network"]["memory"] == 256
    assert config.curriculum["score"] == "max_mc" and config.curriculum["capacity"] == 4000


def test_edits_keep_levels_valid_their_class_and_their_directions() -> None:
    task = tiny_view_task()
    levels = task.space.sample(12, Streams(0).generator()).reshape(2, 6)
    children = edit_levels(levels, 4, [Streams(k).generator() for k in range(2)])
    validate_levels(children)
    assert type(children) is ViewLevel
    again = task.edit(levels, 4, [Streams(k).generator() for k in range(2)])
    assert bool((again == children).all())
    assert torch.equal(children.direction, levels.direction)
    assert not (children.walls == levels.walls).all()


def test_probes_show_levels_and_where_solvers_go() -> None:
    task = tiny_view_task()
    agent = task.learner([Streams(k) for k in range(2)]).agent
    levels = task.target.sample(3, Streams(0).generator())
    probes = task.probe(agent, levels)
    assert probes.shape == (2, 3, 4, 5, 5)
    assert torch.equal(probes[0, :, 0], levels.walls.float())
    torch.testing.assert_close(probes[:, :, 3].sum((-2, -1)), torch.ones(2, 3))
    assert not (probes[:, :, 3] * probes[:, :, 0]).any()  # nobody stands in a wall


def test_records_draw_the_direction_and_the_episode() -> None:
    task = tiny_view_task()
    level = ViewLevel.from_text([">..\n..G"])
    forward = ViewMazeEnv(level).rollout(2, lambda td: td.set("action", torch.tensor([2])))
    (record,) = task.record(level, forward)
    assert record["text"] == ["> • •", ". . G"] and record["path"] == [[0, 0], [0, 1], [0, 2]]
    (record,) = task.record(level, None)
    assert record["text"] == ["> . .", ". . G"]


def test_statistics_count_what_can_be_solved_in_time() -> None:
    task = tiny_view_task()  # 8 steps
    levels = ViewLevel.from_text([">...G", "<.#.G", "<...G", ">#..G"])
    env = ViewMazeEnv(levels.unsqueeze(0), max_steps=8)
    metrics = task.training_metrics(levels.unsqueeze(0), env.rollout(8, break_when_any_done=False))
    assert float(metrics["solvable"]) == 0.5
    assert float(metrics["obstacle_fraction"]) == pytest.approx(0.1)


def test_a_run_is_trained_resumed_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["+method=accel", "seed=2", "schedule.updates=4"]
    assert run(tmp_path / "once", *words) == 0
    rows = read_csv(tmp_path / "once" / "metrics.csv")
    assert float(rows[-1]["curriculum_frames"]) > 0
    newest = max((tmp_path / "once" / "checkpoints").iterdir())
    newest.unlink()
    assert run(tmp_path / "once", *words) == 0
    for before, after in zip(rows, read_csv(tmp_path / "once" / "metrics.csv"), strict=True):
        assert {**before, "seconds": 0} == {**after, "seconds": 0}
    Path("mine.txt").write_text("[hall]\n>..G\n[turn]\n<.G\n")
    evaluate(["once", "--levels", "mine.txt", "-o", "scores.json"])
    scores = {row["level"]: row for row in json.loads(Path("scores.json").read_text())}
    assert list(scores) == ["hall", "turn"]
    for row in scores.values():
        assert row["success_low"] <= row["success"] <= row["success_high"]
        assert row["success"] * 5 == round(row["success"] * 5)  # of 5 episodes
        assert row["max_steps"] == 12
