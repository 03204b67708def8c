"""Real workers of both kinds, on this machine: the numbers of one process, also where one dies."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from signal import SIGKILL, SIGTERM, getsignal, signal
from typing import Any

import pytest
import torch

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import task_maker
from proposer_rl.curricula import ProposerCurriculum, TaskStudent
from proposer_rl.learning import DivergedError
from proposer_rl.meta import replicas as replicas_module
from proposer_rl.meta.replicas import shares
from proposer_rl.meta.rewards import Reward, TrainingStep, performance_gain
from proposer_rl.meta.workers import WorkersError, WorkerSettings
from proposer_rl.methods import Components, proposer
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task
from tests.tiny import composed

COPIES = 3
OVERRIDES = ["+method=perf_gain", "+scale=smoke", f"proposer.rollouts={COPIES}"]
# Three actions for each copy: the Proposer's forward pass is over all copies, wherever it is made.
OVERRIDES += ["proposer.action_repeat=1", "compute.threads=1"]


def workers(engine: Any) -> WorkerSettings:
    return WorkerSettings(engine=engine, workers=2, devices=["cpu"], cores=1)


def make(
    elsewhere: WorkerSettings | None, reward: Reward = performance_gain
) -> tuple[Task, ProposerCurriculum]:
    settings = composed(*OVERRIDES)
    maker = task_maker(settings.task)

    def make_in_worker(device: str) -> Task:
        return maker(solver=settings.solver, context=ComputeContext(torch.device(device)))

    task = make_task(settings)
    found = None if elsewhere is None else (elsewhere, make_in_worker)
    return task, proposer(Components(task, settings.proposer, 0, workers=found), reward=reward)


def cycles(
    task: Task,
    curriculum: ProposerCurriculum,
    count: int = 2,
    between: Callable[[], None] = lambda: None,
) -> tuple[list[Any], list[float]]:
    """What comes of cycles before each of which the Solver has trained: choices, and numbers."""
    assert curriculum.trainer is not None
    solver = task.learner([Streams(0, "solver")])
    chosen: list[Any] = []
    numbers: list[float] = []
    for cycle in range(count):
        student = TaskStudent(task, solver)
        metrics = curriculum.improve(student, Streams(0, "cycle", cycle))
        stream = Streams(0, "update", cycle)
        levels = curriculum.propose(student, task.batch_size, stream)
        solver.env.set_levels(levels.unsqueeze(0))
        update = solver.update([stream.generator("actions")])
        chosen += [metrics.pop("histogram"), student.frames, student.evaluations, metrics.keys()]
        chosen += [levels.to_text(), update.rollout["action"].tolist()]
        for value in metrics.values():
            numbers += value if isinstance(value, list) else [] if value is None else [value]
        numbers += update.rollout["next", "state_value"].flatten().tolist()
        numbers += [float(value) for value in update.metrics.values()]
        between()
    for learner in (solver, curriculum.trainer.learner):
        for entry in learner.snapshot().values(True, True):
            numbers += entry.flatten().tolist()
    return chosen, numbers


Came = tuple[list[Any], list[float]]


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Processes are forks of one that has imported everything; ``test_command`` starts others."""
    before = multiprocessing.get_start_method(allow_none=True)
    multiprocessing.set_forkserver_preload(["proposer_rl.cli.build"])
    multiprocessing.set_start_method("forkserver", force=True)
    yield
    multiprocessing.set_start_method(before, force=True)


@pytest.fixture(scope="module")
def here() -> Came:
    return cycles(*make(None))


def assert_near(one: Came, other: Came) -> None:
    """The same choices; the same numbers but for rounding, which Adam makes larger."""
    assert one[0] == other[0]
    assert one[1] == pytest.approx(other[1], rel=1e-5, abs=1e-6)


def lethal(fuse: Path) -> Reward:
    """A reward that kills the first process to compute it while there is a fuse."""

    def reward(step: TrainingStep) -> torch.Tensor:
        with suppress(FileNotFoundError):
            fuse.unlink()
            os.kill(os.getpid(), SIGKILL)
        return performance_gain(step)

    return reward


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["multiprocess", "ray"])
def test_workers_give_the_numbers_of_one_process_also_where_they_die(
    engine: str, here: Came, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_worker_niceness", "0")  # else 15: where others compute, none starts
    fuse = tmp_path / "fuse"
    fuse.touch()
    task, curriculum = make(workers(engine), lethal(fuse))
    replicas: Any = curriculum.trainer.replicas
    losses = iter([True, False])

    def kill_one_between_the_cycles() -> None:
        if engine == "multiprocess" and next(losses):
            process = replicas._collector.procs[1]
            os.kill(process.pid, SIGKILL)
            process.join(60)

    handler = signal(SIGTERM, lambda *_: None)
    try:
        ours, threads = getsignal(SIGTERM), torch.get_num_threads()
        # Three copies over two workers; one is killed in the middle of the first cycle.
        with pytest.warns(RuntimeWarning, match="a worker was lost") as warned:
            came = cycles(task, curriculum, between=kill_one_between_the_cycles)
        lost = sum("a worker was lost" in str(w.message) for w in warned)
        assert lost == (2 if engine == "multiprocess" else 1)
        # What Ray and TorchRL's collectors change in this process is put back.
        assert getsignal(SIGTERM) is ours and torch.get_num_threads() == threads
        assert not fuse.exists()
        assert_near(came, here)
        if engine == "multiprocess":
            diverges(task, curriculum)
    finally:
        signal(SIGTERM, handler)
        curriculum.close()


def diverges(task: Any, curriculum: Any) -> None:
    """A Solver with a weight that is no number: all its copies diverge at once, and it is told."""
    solver = task.learner([Streams(0, "solver")])
    broken = solver.snapshot()
    next(iter(broken.values()))["value"].fill_(torch.nan)
    solver.restore(broken)
    with pytest.raises(DivergedError, match="update 0 of the episode of the So"):
        curriculum.improve(TaskStudent(task, solver), Streams(0, "cycle", 0))


def test_workers_that_are_lost_again_and_again_stop_the_run(monkeypatch) -> None:
    task, curriculum = make(workers("multiprocess"))
    checked: list[int] = []
    started: list[int] = []
    curriculum.trainer.env.on_update = checked.append

    def start(*_: object, **__: object) -> None:
        started.append(1)
        raise RuntimeError("Traceback of the worker\nof many lines\nit fell off")

    monkeypatch.setattr(replicas_module, "start", start)
    solver = task.learner([Streams(0, "solver")])
    with (
        pytest.warns(RuntimeWarning, match="lost .it fell off.; it is replaced"),
        pytest.raises(
            WorkersError, match="workers=2: were lost 3 times in one cycle, last: it fell off; the"
        ),
    ):
        curriculum.improve(TaskStudent(task, solver), Streams(0, "cycle", 0))
    # Between two attempts a signal that has come with the loss is acted on.
    assert (len(started), checked) == (3, [0, 0])


@pytest.mark.parametrize("copies", range(1, 9))
def test_shares_are_all_copies_in_ranges_of_one_length(copies: int) -> None:
    for count in range(1, copies + 3):
        parts = shares(copies, count)
        assert {copy for part in parts for copy in part} == set(range(copies))
        assert len(parts) == count and {len(part) for part in parts} == {-(-copies // count)}
