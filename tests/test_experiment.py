"""The outer loop against a plain loop, and what it asks of a curriculum."""

from __future__ import annotations

import os
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path
from signal import SIG_DFL, SIGTERM, signal
from typing import Any

import numpy as np
import pytest
import torch

from proposer_rl import curricula as c
from proposer_rl.curricula import SamplingCurriculum, Scorer, TaskStudent, outcome_of
from proposer_rl.experiment import Experiment, ScheduleSettings
from proposer_rl.learning import PPO
from proposer_rl.runs.checkpoint import CheckpointError, load_latest
from proposer_rl.runs.folder import RunFolder, read_csv, read_jsonl
from proposer_rl.runs.process import Interrupted, StopSignals
from proposer_rl.streams import Streams
from proposer_rl.task import Levels, NoSuccessError, Task
from proposer_rl.tasks.mazes.levels import shortest_path_length
from proposer_rl.teaching import Teacher
from tests.curricula.made import MADE
from tests.same_run import StopAt, assert_same_run, tables
from tests.tiny import TASK, mountain_cars

LENGTHS = {"updates": 5, "cycle_length": 2, "evaluate_every": 2, "checkpoint_every": 3}
P, T = 4, 8


def learner(*seeds: int, task: Task = TASK) -> PPO:
    return task.learner([Streams(seed, "solver") for seed in seeds])


def experiment(
    path: Path, *seeds: int, curriculum: Any = None, task: Task = TASK, **options: Any
) -> Experiment:
    """A run of several seeds needs a curriculum each, or draws from the target."""
    lengths = {key: options.pop(key) for key in list(options) if hasattr(ScheduleSettings, key)}
    lengths = {"headline": task.metrics[0], "threshold": 0.1, **LENGTHS, **lengths}
    given = curriculum if isinstance(curriculum, list) else [curriculum]
    return Experiment(
        task,
        learner(*seeds, task=task),
        given if curriculum else [SamplingCurriculum(task.target) for _ in seeds],
        schedule=ScheduleSettings(**lengths),
        seeds=seeds,
        folder=RunFolder(path),
        progress=False,
        **options,
    )


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Experiment, dict, Path]:
    """A run of seed 7 without a Proposer, its summary and its folder."""
    run = experiment(folder := tmp_path_factory.mktemp("plain"), 7)
    return run, run.run(), folder


def test_a_run_is_a_plain_loop_of_updates(plain: tuple[Experiment, dict, Path]) -> None:
    run, summary, folder = plain
    solver = learner(7)
    success = {0: float(TASK.measure(solver.agent)["id_success"])}
    for update in range(5):
        streams = Streams(7, "update", update)
        solver.env.set_levels(TASK.target.sample(P, streams.generator("levels"))[None])
        solver.update([streams.generator("actions")])
        success[update + 1] = float(TASK.measure(solver.agent)["id_success"])
    rows = read_csv(folder / "metrics.csv")
    assert [row["updates"] for row in rows] == [0, 2, 4, 5]
    assert [row["id_success"] for row in rows] == [success[row["updates"]] for row in rows]
    assert (run.learner.snapshot() == solver.snapshot()).all()
    first = next((row["updates"] for row in rows if row["id_success"] >= 0.1), None)
    assert summary["updates_to_threshold"] == [first]
    assert summary["frames"] == 5 * P * T
    assert summary["curriculum_frames"] == summary["evaluations"] == 0
    # The target is the last of the four bins, and nothing else is told of a cycle.
    cycles = read_jsonl(folder / "cycles.jsonl")
    assert [row["histogram"] for row in cycles] == [[[0, 0], [0, n * P]] for n in (2, 2, 1)]
    costs = {"curriculum_frames": 0, "evaluations": 0}
    assert [{**costs, **row} for row in cycles] == cycles and len(cycles[0]) == 5


def test_a_teacher_in_a_plain_loop_trains_the_same_solvers(tmp_path: Path) -> None:
    """The outer loop has no way into a curriculum that others have not."""
    run = experiment(tmp_path, 7, curriculum=MADE["plr"](), updates=8)
    run.run()
    solvers = learner(7)
    able = TaskStudent(TASK, solvers)
    teacher = Teacher(MADE["plr"](), TASK, seed=7, student=able)
    for update in range(8):
        solvers.env.set_levels(teacher.propose(P).unsqueeze(0))
        actions = Streams(7, "update", update).generator("actions")
        teacher.observe(outcome_of(solvers.update([actions]).rollout[0]))
    assert (run.learner.snapshot() == solvers.snapshot()).all()
    assert 0 < teacher.log()["replayed"] < 1


def test_the_paths_that_are_recorded_are_legal(plain: tuple[Experiment, dict, Path]) -> None:
    samples = read_jsonl(plain[2] / "curriculum.jsonl")
    assert [sample["updates"] for sample in samples] == [2, 4, 5]
    for sample in samples:
        assert len(sample["levels"]) == P
        for item in sample["levels"]:
            rows, path = [row.replace(" ", "") for row in item["text"]], item["path"]
            assert rows[path[0][0]][path[0][1]] == "S"
            assert all(rows[r][c] != "#" for r, c in path)
            assert all(abs(r - s) + abs(c - d) <= 1 for (r, c), (s, d) in pairwise(path))
            ends = rows[path[-1][0]][path[-1][1]]
            assert ends == "G" or len(path) == 9


class Costly(c.LearnedCurriculum):
    """Notes what it is called for, and says that all of it has a price."""

    state: tuple[str, ...] = ("observed",)

    def __init__(self) -> None:
        self.events: list[tuple] = []
        self.target = SamplingCurriculum(TASK.target)
        self.observed = 0

    def propose(self, student, count, rng) -> Levels:
        self.events.append(("propose", count))
        student.spend(frames=10, evaluations=1)
        return self.target.propose(student, count, rng)

    def observe(self, student, batch, outcome) -> None:
        assert batch.levels.batch_size == (P,) == outcome.batch_size
        assert outcome["rollout"].batch_size == (P, T)
        self.events.append(("observe",))
        self.observed += 1

    def improve(self, student, rng) -> dict:
        self.events.append(("improve",))
        student.spend(frames=1000, evaluations=100)
        return {"own": ["improved"]}

    def log(self) -> dict:
        observed, self.observed = self.observed, 0
        return {"observed": observed} if observed else {}


class Demanding(SamplingCurriculum):
    needs = ("optimal_return",)


def test_a_student_that_lacks_something_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    cars = mountain_cars()
    with pytest.raises(c.UnfitStudentError, match="Demanding needs a student with optimal_return"):
        experiment(tmp_path / "run", 0, curriculum=Demanding(cars.space), task=cars)
    assert not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize("reads", ["outcomes", "plays of candidates", "plays before a filter"])
def test_success_of_a_task_that_has_none_is_refused_before_anything_is_written(
    reads: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TASK, "results", ("return",))
    scorer = Scorer("learnability", "episodes")
    reader: c.Curriculum = {
        "outcomes": c.LearningProgressCurriculum(TASK.space, source="episodes"),
        "plays of candidates": c.SelectionCurriculum(TASK.target, scorer, candidates=4, keep=2),
        "plays before a filter": c.Filtered(SamplingCurriculum(TASK.target), scorer),
    }[reads]
    with pytest.raises(NoSuccessError, match=f"{type(reader).__name__}: reads success"):
        experiment(tmp_path, 0, curriculum=reader, headline="id_return", threshold=-0.1)
    assert [*tmp_path.iterdir()] == []


def test_an_improvement_that_cost_frames_is_saved_at_once(tmp_path: Path) -> None:
    class Silent(Costly):
        crashes = False

        def improve(self, student, rng) -> dict:
            super().improve(student, rng)
            return {}

        def propose(self, student, count, rng) -> Levels:
            if self.crashes:
                raise RuntimeError("the machine is switched off")
            return super().propose(student, count, rng)

    first, again = Silent(), Silent()
    first.crashes = True
    with pytest.raises(RuntimeError, match="switched off"):
        experiment(tmp_path, 0, curriculum=first).run()
    experiment(tmp_path, 0, curriculum=again).run()
    assert (first.events[0], again.events[0]) == (("improve",), ("propose", P))


@pytest.mark.parametrize("interrupted", [False, True])
def test_what_a_curriculum_costs_is_counted_written_and_survives(
    interrupted: bool, tmp_path: Path
) -> None:
    if interrupted:
        with pytest.raises(Interrupted):
            experiment(tmp_path, 0, curriculum=Costly(), signals=StopAt(4)).run()
    summary = experiment(tmp_path, 0, curriculum=(curriculum := Costly())).run()
    if not interrupted:  # it is improved once for each cycle, and sees every update
        cycle = [("improve",), ("propose", P), ("observe",), ("propose", P), ("observe",)]
        assert curriculum.events == [*cycle, *cycle, *cycle[:3]]
    rows = read_csv(tmp_path / "metrics.csv")
    # By updates: one of 10 and 1 for each, one of 1000 and 100 for each cycle that has begun.
    costs = {0: (0, 0), 2: (1020, 102), 4: (2040, 204), 5: (3050, 305)}
    told = {row["updates"]: (row["curriculum_frames"], row["evaluations"]) for row in rows}
    assert told == costs
    assert (summary["curriculum_frames"], summary["evaluations"]) == costs[5]
    cycles = read_jsonl(tmp_path / "cycles.jsonl")
    # Each cycle as it begins, with what the one before has to tell; then the last one's word.
    places = [(0, 0, 1000, 100), (1, 2, 2020, 202), (2, 4, 3040, 304), (3, 5, 3050, 305)]
    keys = ("cycle", "updates", "curriculum_frames", "evaluations")
    expected = [dict(zip(keys, place, strict=True)) for place in places]
    for row in expected[:3]:
        row["own"] = ["improved"]
    for row, observed in zip(expected[1:], (2, 2, 1), strict=True):
        row["observed"] = observed
        row["histogram"] = [[0, 0], [0, observed * P]]
    assert cycles == expected


def test_where_the_levels_of_a_cycle_lie_is_recorded(tmp_path: Path) -> None:
    """Of levels that no curriculum's own record tells; in a run that goes on, too."""
    for updates in (3, 5):
        uniform = SamplingCurriculum(TASK.space)
        experiment(tmp_path, 3, curriculum=uniform, updates=updates, cycle_length=4).run()
    expected = np.zeros((2, 2), int)
    for update in range(5):
        if update == 4:
            expected[:] = 0
        stream = Streams(3, "update", update).generator("levels")
        for level in TASK.space.sample(P, stream):
            far = int(shortest_path_length(level)) > 3  # of 2 and 4
            expected[int(float(level.walls.float().mean()) > 0.1), int(far)] += 1
        if update == 3:
            first = expected.tolist()
    rows = [row["histogram"] for row in read_jsonl(tmp_path / "cycles.jsonl")]
    assert rows == [first, expected.tolist()]


def test_what_a_curriculum_tells_of_its_proposals_stays(tmp_path: Path) -> None:
    class Tells(SamplingCurriculum):
        def log(self) -> dict:
            return {"histogram": [[1, 2], [3, 4]]}

    experiment(tmp_path, 0, curriculum=Tells(TASK.target)).run()
    assert read_jsonl(tmp_path / "cycles.jsonl")[-1]["histogram"] == [[1, 2], [3, 4]]


def test_a_longer_schedule_goes_on_as_if_it_had_been_so_long_from_the_start(
    tmp_path: Path,
) -> None:
    experiment(tmp_path / "whole", 0, curriculum=Costly(), updates=7).run()
    experiment(tmp_path / "run", 0, curriculum=Costly(), updates=5).run()
    experiment(tmp_path / "run", 0, curriculum=Costly(), updates=7).run()
    rows = [read_jsonl(tmp_path / name / "cycles.jsonl") for name in ("whole", "run")]
    assert rows[0] == rows[1]


class Stopped(Costly):
    """A signal comes in the middle of its second improvement."""

    state = ("observed", "begun")

    def __init__(self, signals: StopSignals | None) -> None:
        super().__init__()
        self.signals = signals
        self.begun = torch.zeros(())

    def improve(self, student, rng) -> dict:
        # What is begun here must be undone, also what has changed in place.
        self.begun += 1
        student._learner.env.set_levels(TASK.target.sample(P, rng.generator("levels"))[None])
        student._learner.update([rng.generator("actions")])
        if self.begun == 2 and self.signals is not None:
            os.kill(os.getpid(), SIGTERM)
            self.signals.check()
        return super().improve(student, rng)


@pytest.mark.parametrize("handled", [False, True])
def test_a_signal_within_an_improvement_undoes_what_was_begun(
    handled: bool, tmp_path: Path
) -> None:
    experiment(tmp_path / "whole", 0, curriculum=Stopped(None)).run()
    signals = StopSignals()
    run = experiment(tmp_path / "run", 0, curriculum=Stopped(signals), signals=signals)

    def goes_on(*_: object) -> None:
        run.sides.curricula[0].signals = None

    before = signal(SIGTERM, goes_on if handled else SIG_DFL)
    try:
        with signals, nullcontext() if handled else pytest.raises(Interrupted):
            run.run()
    finally:
        signal(SIGTERM, before)
    if not handled:
        latest = load_latest(tmp_path / "run" / "checkpoints")
        assert latest is not None
        state = latest[1]
        assert (state["updates"], state["cycles"]) == (2, 1)
        assert state["curricula"][0]["begun"] == 1
        experiment(tmp_path / "run", 0, curriculum=Stopped(None)).run()
    assert_same_run(tmp_path / "whole", tmp_path / "run")


def test_a_checkpoint_of_another_population_is_refused(tmp_path: Path) -> None:
    experiment(tmp_path, 0, 1).run()
    with pytest.raises(CheckpointError, match="does not fit this run"):
        experiment(tmp_path, 0).run()


def test_a_threshold_is_reached_by_being_met(plain: Any, tmp_path: Path) -> None:
    """That of a return may be any number."""
    best = max(read_csv(plain[2] / "metrics.csv"), key=lambda row: row["id_success"])
    met, updates = np.float32(best["id_success"]), best["updates"]
    for number, (headline, threshold, reached) in enumerate([
        ("success", met, updates), ("success", np.nextafter(met, 2), updates),
        ("success", met + 1e-4, None), ("return", -1e6, 0), ("return", 1e6, None),
    ]):  # fmt: skip
        folder, asked = tmp_path / str(number), {"threshold": float(threshold)}
        summary = experiment(folder, 7, headline=f"id_{headline}", **asked).run()
        assert summary["updates_to_threshold"] == [reached]
        assert tables(folder)["metrics.csv"] == tables(plain[2])["metrics.csv"]


def test_rows_of_the_first_copy_are_logged(tmp_path: Path) -> None:
    seen = []
    run = experiment(tmp_path, 3, 4, log=lambda table, row, step: seen.append((table, step, row)))
    run.run()
    assert {(table, step) for table, step, _ in seen} >= {("metrics", 0), ("training", 5)}
    first = next(row for table, step, row in seen if (table, step) == ("metrics", 5))
    rows = read_csv(tmp_path / "metrics.csv")
    expected = next(row for row in rows if row["updates"] == 5 and row["seed"] == 3)
    assert first["id_success"] == expected["id_success"]
