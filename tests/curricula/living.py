"""A curriculum and students who train on what it proposes, as in a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from proposer_rl.curricula import Curriculum, TaskStudent, outcome_of
from proposer_rl.experiment.loop import SideBySide
from proposer_rl.learning import PPO, PPOSettings, SolverSettings
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes.task import UNetSettings
from tests.tiny import tiny_task

# What holds of a curriculum does not hang on how much a Solver makes of its levels.
TASK = tiny_task(
    network=UNetSettings(channels=[8], groups=4),
    solver=SolverSettings(batch_size=4, ppo=PPOSettings(horizon=8, epochs=1, learning_rate=3e-3)),
)


class Lived(NamedTuple):
    """What there was to see: each update's levels [n], its cost and its rollout [n, T]."""

    levels: list[Any]
    frames: list[int]
    evaluations: list[int]
    rollouts: list[Any]
    told: list[dict[str, Any]]


def solvers(seeds: Sequence[int]) -> PPO:
    return TASK.learner([Streams(seed, "solver") for seed in seeds])


def student(seed: int = 0) -> TaskStudent:
    return TaskStudent(TASK, solvers([seed]))


def live(
    curricula: Sequence[Curriculum],
    learner: PPO,
    seeds: Sequence[int],
    updates: range,
    cycle: int = 3,
) -> list[Lived]:
    """Train Solvers side by side, each on a curriculum of its own."""
    lives = [Lived([], [], [], [], []) for _ in seeds]
    sides = SideBySide(TASK, learner, curricula)
    for number in updates:
        if number % cycle == 0:
            metrics = sides.improve([Streams(seed, "cycle", number) for seed in seeds])
            for life, curriculum, own in zip(lives, curricula, metrics, strict=True):
                life.told.append({**curriculum.log(), **own})
        for student in sides.students:
            student.frames, student.evaluations = 0, 0
        streams = [Streams(seed, "update", number) for seed in seeds]
        batches = sides.propose(TASK.batch_size, streams)
        learner.env.set_levels(torch.stack([batch.levels for batch in batches]))
        update = learner.update([stream.generator("actions") for stream in streams])
        outcomes = map(outcome_of, update.rollout)
        sides.observe([[credit] for credit in zip(batches, outcomes, strict=True)])
        each = zip(lives, batches, sides.students, update.rollout, strict=True)
        for life, batch, student, rollout in each:
            seen = batch.levels, student.frames, student.evaluations, rollout
            for entries, entry in zip(life, seen, strict=False):
                entries.append(entry)
    return lives
