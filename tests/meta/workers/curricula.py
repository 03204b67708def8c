"""A small Proposer's curriculum, its copies here or in workers, and what came of its cycles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from proposer_rl.cli.build import make_task
from proposer_rl.cli.config import RunConfig, task_maker
from proposer_rl.curricula import ProposerCurriculum, TaskStudent
from proposer_rl.meta.rewards import Reward, performance_gain
from proposer_rl.meta.workers import WorkerSettings
from proposer_rl.methods import Components, proposer
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task
from tests.tiny import composed

COPIES = 3
OVERRIDES = ["+method=perf_gain", "+scale=smoke", f"proposer.rollouts={COPIES}"]
# Three actions for each copy: the Proposer's forward pass is over all copies, wherever it is made.
OVERRIDES += ["proposer.action_repeat=1", "compute.threads=1"]


def config(*overrides: str) -> RunConfig:
    return composed(*OVERRIDES, *overrides)


def workers(engine: Any, count: int = 2) -> WorkerSettings:
    return WorkerSettings(engine=engine, workers=count, devices=["cpu"], cores=1)


def make(
    elsewhere: WorkerSettings | None,
    reward: Reward = performance_gain,
    *overrides: str,
) -> tuple[Task, ProposerCurriculum]:
    settings = config(*overrides)
    maker, solver = task_maker(settings.task), settings.solver

    def make_in_worker(device: str) -> Task:
        return maker(solver=solver, context=ComputeContext(torch.device(device)))

    task = make_task(settings)
    found = None if elsewhere is None else (elsewhere, make_in_worker)
    parts = Components(task, settings.proposer, seed=0, workers=found)
    return task, proposer(parts, reward=reward)


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
