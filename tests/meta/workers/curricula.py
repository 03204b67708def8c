"""A small Proposer's curriculum, its copies here or in workers, and what came of its cycles."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import CONFIG_FOLDER, RunConfig, read_config
from proposer_rl.curricula import ProposerCurriculum
from proposer_rl.mazes.task import MazeTask
from proposer_rl.meta.rewards import Reward, performance_gain
from proposer_rl.meta.workers import WorkerSettings
from proposer_rl.methods import Parts, proposer
from proposer_rl.streams import Streams

COPIES = 3
OVERRIDES = ["+method=perf_gain", "+scale=smoke", f"proposer.rollouts={COPIES}"]
# Three actions for each copy: the Proposer's forward pass is over all copies, wherever it is made.
OVERRIDES += ["proposer.advance=best", "proposer.updates_per_step=1", "threads=1"]


class Hangs(BaseException):
    """Not an Exception: nothing may take it for the loss of a worker."""


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """Fail instead of waiting for ever."""

    def give_up(*_: object) -> None:
        raise Hangs(f"nothing came of it for {seconds} seconds")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def config(*overrides: str) -> RunConfig:
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        return read_config(compose("train", [*OVERRIDES, *overrides]))


def workers(engine: Any, count: int = 2) -> WorkerSettings:
    return WorkerSettings(engine=engine, workers=count, devices=["cpu"], cores=1)


def make(
    elsewhere: WorkerSettings | None, reward: Reward = performance_gain, *overrides: str
) -> tuple[MazeTask, ProposerCurriculum]:
    settings = config(*overrides)
    task = make_task(settings)
    parts = Parts(task, settings.proposer, seed=0, workers=elsewhere)
    curriculum: Any = proposer(parts, reward)
    return task, curriculum


def cycles(
    task: MazeTask,
    curriculum: ProposerCurriculum,
    count: int = 2,
    between: Callable[[], None] = lambda: None,
) -> list[Any]:
    """All that comes of cycles in which the Solver becomes the best copy: plain, to compare."""
    solver = task.solvers([Streams(0, "solver")])
    came: list[Any] = []
    for cycle in range(count):
        outcome = curriculum.improve(solver, [Streams(0, "cycle", cycle)])
        assert outcome.advance is not None
        levels, update = outcome.advance.levels, outcome.advance.update
        came += [outcome.metrics, outcome.meta_frames, levels.to_text()]
        came += [update.rollout["action"].tolist(), _bits(update.rollout["next", "state_value"])]
        came += [_bits(update.metrics["loss_critic"]), _bits(update.metrics["grad_norm"])]
        between()
    for learner in (solver, curriculum.proposer):
        came += [_bits(x) for x in learner.snapshot().values(True, True)]
    return came


def _bits(tensor: Any) -> bytes:
    return tensor.detach().contiguous().numpy().tobytes()
