"""The outer loop against a plain loop, and several seeds in one population against each alone."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
import torch

from proposer_rl.curricula import Curriculum, SamplingCurriculum
from proposer_rl.experiment import Experiment, Schedule
from proposer_rl.learning.ppo import PPOSettings
from proposer_rl.mazes.task import (
    DistributionSettings,
    EvaluationSettings,
    MazeSettings,
    MazeTask,
    SolverSettings,
    SpaceSettings,
)
from proposer_rl.runs.folder import RunFolder, read_csv, read_jsonl
from proposer_rl.streams import Streams

SCHEDULE = Schedule(updates=5, cycle_length=2, evaluate_every=2, checkpoint_every=3, threshold=0.1)


def task() -> MazeTask:
    return MazeTask(
        maze=MazeSettings(height=5, width=5, max_steps=8),
        distributions={"id": DistributionSettings(specifications=[(0.2, 3)])},
        target="id",
        space=SpaceSettings(obstacle_fractions=[0.0, 0.2], path_lengths=[2, 4]),
        solver=SolverSettings(
            channels=[8, 8],
            groups=4,
            problems=4,
            ppo=PPOSettings(horizon=8, epochs=2, learning_rate=3e-3),
        ),
        evaluation=EvaluationSettings(distributions=["id"], levels=8),
    )


def experiment(
    path: Path, *seeds: int, curriculum: Curriculum | None = None, **options
) -> Experiment:
    parts = task()
    return Experiment(
        parts.solvers([Streams(seed, "solver") for seed in seeds]),
        curriculum or SamplingCurriculum(parts.sample_target),
        schedule=SCHEDULE,
        seeds=seeds,
        folder=RunFolder(path),
        evaluate=parts.measure,
        statistics=parts.statistics,
        records=parts.records,
        progress=False,
        **options,
    )


def test_a_run_is_a_plain_loop_of_updates(tmp_path: Path) -> None:
    run = experiment(tmp_path, 7)
    summary = run.run()
    parts = task()
    solver = parts.solvers([Streams(7, "solver")])
    success = {0: float(parts.measure(solver.agent)["id_success"])}
    for update in range(5):
        streams = Streams(7, "update", update)
        levels = parts.sample_target(4, streams.generator("levels"))
        solver.env.set_levels(levels[None])
        solver.update([streams.generator("actions")])
        success[update + 1] = float(parts.measure(solver.agent)["id_success"])
    rows = read_csv(tmp_path / "metrics.csv")
    assert [row["updates"] for row in rows] == [0, 2, 4, 5]
    assert [row["id_success"] for row in rows] == [success[row["updates"]] for row in rows]
    assert (run.solver.snapshot() == solver.snapshot()).all()
    first = next((row["updates"] for row in rows if row["id_success"] >= 0.1), None)
    assert summary["updates_to_threshold"] == [first]
    assert summary["frames"] == 5 * 4 * 8 and summary["meta_frames"] == 0


# PPO's own metrics in training.csv are means over the population.
PER_COPY = {
    "metrics.csv": ["id_success", "id_return", "id_greedy_success", "id_greedy_return"],
    "training.csv": ["obstacle_fraction", "path_length", "path_length_sd", "train_success"],
}


def test_seeds_in_one_population_are_those_of_separate_runs(tmp_path: Path) -> None:
    experiment(tmp_path / "both", 1, 2).run()
    for seed in (1, 2):
        experiment(tmp_path / str(seed), seed).run()
        for table, names in PER_COPY.items():
            rows = read_csv(tmp_path / "both" / table)
            together = [row for row in rows if row["seed"] == seed]
            for row, alone in zip(together, read_csv(tmp_path / str(seed) / table), strict=True):
                for name in names:
                    assert row[name] == pytest.approx(alone[name], rel=1e-4, abs=1e-6), name


def test_the_paths_that_are_recorded_are_legal(tmp_path: Path) -> None:
    experiment(tmp_path, 0).run()
    samples = read_jsonl(tmp_path / "curriculum.jsonl")
    assert [sample["updates"] for sample in samples] == [2, 4, 5]
    for sample in samples:
        assert len(sample["levels"]) == 4
        for item in sample["levels"]:
            rows, path = item["level"], item["path"]
            assert rows[path[0][0]][path[0][1]] == "S"
            assert all(rows[r][c] != "#" for r, c in path)
            assert all(abs(r - s) + abs(c - d) <= 1 for (r, c), (s, d) in pairwise(path))
            ends = rows[path[-1][0]][path[-1][1]]
            assert ends == "G" or len(path) == 9


def test_the_curriculum_is_improved_once_per_cycle_and_sees_every_update(tmp_path: Path) -> None:
    events: list[str] = []

    class Recorder(SamplingCurriculum):
        def propose(self, solver, streams):
            events.append("propose")
            return super().propose(solver, streams)

        def observe(self, levels, rollout):
            assert rollout.batch_size == (1, 4, 8)
            events.append("observe")

        def improve(self, solver, streams, pause):
            events.append("improve")
            return super().improve(solver, streams, pause)

    experiment(tmp_path, 0, curriculum=Recorder(task().sample_target)).run()
    update = ["propose", "observe"]
    cycle = ["improve", *update, *update]
    assert events == [*cycle, *cycle, "improve", *update]


def test_rows_of_the_first_copy_are_logged(tmp_path: Path) -> None:
    seen = []
    run = experiment(tmp_path, 3, 4, log=lambda table, row, step: seen.append((table, step, row)))
    run.run()
    assert {(table, step) for table, step, _ in seen} >= {("metrics", 0), ("training", 5)}
    first = next(row for table, step, row in seen if (table, step) == ("metrics", 5))
    rows = read_csv(tmp_path / "metrics.csv")
    expected = next(row for row in rows if row["updates"] == 5 and row["seed"] == 3)
    assert first["id_success"] == expected["id_success"]


def test_a_task_refuses_an_unknown_target() -> None:
    parts = task()
    with pytest.raises(ValueError, match=r"'far' is none of the distributions \['id'\]"):
        MazeTask(
            maze=parts.maze,
            distributions={"id": DistributionSettings(specifications=[(0.2, 3)])},
            target="far",
            space=SpaceSettings(obstacle_fractions=[0.0], path_lengths=[2]),
            solver=parts.solver,
            evaluation=EvaluationSettings(distributions=["id"], levels=2),
        )


def test_evaluation_levels_are_the_same_in_every_run() -> None:
    one, other = task(), task()
    solver = one.solvers([Streams(0)])
    assert torch.equal(
        one.measure(solver.agent)["id_return"], other.measure(solver.agent)["id_return"]
    )
