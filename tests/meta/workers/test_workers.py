"""Real workers of both kinds, on this machine: the numbers of one process, also where one dies."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from signal import SIGKILL, SIGTERM, getsignal, signal
from typing import Any

import pytest
import torch

from proposer_rl.learning.divergence import DivergedError
from proposer_rl.meta.rewards import Reward, TrainingStep, performance_gain
from proposer_rl.meta.workers import CopiesInWorkers, WorkersError, shares
from proposer_rl.meta.workers import copies as copies_module
from proposer_rl.streams import Streams
from tests.meta.workers.curricula import COPIES, cycles, make, within, workers

SECONDS = 120


@pytest.fixture(scope="module")
def here() -> list[Any]:
    return cycles(*make(None))


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
def test_workers_give_the_numbers_of_one_process_also_where_one_dies(
    engine: str, here: list[Any], tmp_path: Path
) -> None:
    fuse = tmp_path / "fuse"
    fuse.touch()
    task, curriculum = make(workers(engine), lethal(fuse))
    handler = signal(SIGTERM, lambda *_: None)
    try:
        ours, threads = getsignal(SIGTERM), torch.get_num_threads()
        # Three copies over two workers; one is killed in the middle of the first cycle.
        with within(SECONDS), pytest.warns(RuntimeWarning, match="a worker was lost") as warned:
            came = cycles(task, curriculum)
        assert sum("a worker was lost" in str(w.message) for w in warned) == 1
        # What Ray and TorchRL's collectors change in this process is put back.
        assert getsignal(SIGTERM) is ours and torch.get_num_threads() == threads
    finally:
        signal(SIGTERM, handler)
        with within(SECONDS):
            curriculum.close()
    assert not fuse.exists()
    assert came == here


@pytest.mark.slow
def test_a_worker_that_dies_between_cycles_is_replaced_and_divergence_is_told(
    here: list[Any],
) -> None:
    task, curriculum = make(workers("multiprocess"))
    copies: Any = curriculum.copies

    def kill_one() -> None:
        process = copies._collector.procs[1]
        os.kill(process.pid, SIGKILL)
        process.join()

    with within(SECONDS), pytest.warns(RuntimeWarning, match="a worker was lost"):
        assert cycles(task, curriculum, between=kill_one) == here
    # A Solver with a weight that is no number: all its copies diverge at once.
    solver = task.solvers([Streams(0, "solver")])
    broken = solver.snapshot()
    next(iter(broken.values()))["value"].fill_(torch.nan)
    solver.restore(broken)
    with within(SECONDS), pytest.raises(DivergedError, match="update 0 of the episode of the So"):
        curriculum.improve(solver, [Streams(0, "cycle", 0)])
    with within(SECONDS):
        curriculum.close()


def test_workers_that_are_lost_again_and_again_stop_the_run(monkeypatch) -> None:
    task, curriculum = make(workers("multiprocess"))
    paused, started = [], []

    def start(*_: object) -> None:
        started.append(1)
        raise RuntimeError("Traceback of the worker\nof many lines\nit fell off")

    monkeypatch.setattr(copies_module, "start", start)
    solver = task.solvers([Streams(0, "solver")])
    with (
        pytest.warns(RuntimeWarning, match="lost .it fell off.; it is replaced"),
        pytest.raises(WorkersError, match="lost 3 times in one cycle, last: it fell off; the same"),
    ):
        curriculum.improve(solver, [Streams(0, "cycle", 0)], lambda: paused.append(1))
    # Between two attempts a signal that has come with the loss is acted on.
    assert (len(started), len(paused)) == (3, 2)


@pytest.mark.parametrize("copies", range(1, 9))
def test_shares_are_all_copies_in_nearly_equal_ranges(copies: int) -> None:
    for count in range(1, copies + 1):
        parts = shares(copies, count)
        assert [copy for part in parts for copy in part] == list(range(copies))
        assert len(parts) == count and {len(part) for part in parts} <= {
            copies // count,
            -(-copies // count),
        }
    for count in (0, copies + 1):
        with pytest.raises(ValueError, match="workers must be at least 1 and at most"):
            shares(copies, count)


def test_no_more_workers_than_copies() -> None:
    with pytest.raises(ValueError, match="at most the 3 copies: 4"):
        make(workers("multiprocess", COPIES + 1))


def test_an_episode_in_workers_is_not_saved_in_its_middle() -> None:
    _, curriculum = make(workers("multiprocess"))
    assert isinstance(curriculum.copies, CopiesInWorkers)
    assert curriculum.state_dict()["episode"] is None
