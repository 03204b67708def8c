"""A curriculum and students who train on what it proposes, as in a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from proposer_rl.curricula import Curriculum, LearnedCurriculum, TaskStudent, outcome_of
from proposer_rl.learning import PPO, PPOSettings, SolverSettings, Update
from proposer_rl.streams import Streams
from proposer_rl.tasks.mazes.task import UNetSettings
from tests.tiny import tiny_task

# What holds of a curriculum does not hang on how much a Solver makes of its levels.
TASK = tiny_task(
    network=UNetSettings(channels=[8], groups=4),
    solver=SolverSettings(batch_size=4, ppo=PPOSettings(horizon=8, epochs=1, learning_rate=3e-3)),
)


class Lived(NamedTuple):
    """What there was to see: each update's levels [K, P], its cost and its rollout."""

    levels: list[Any]
    frames: list[int]
    evaluations: list[int]
    updates: list[Update]
    told: list[dict[str, Any]]


def solvers(seeds: Sequence[int]) -> PPO:
    return TASK.learner([Streams(seed, "solver") for seed in seeds])


def student(*seeds: int) -> TaskStudent:
    return TaskStudent(TASK, solvers(seeds or [0]))


def live(
    curriculum: Curriculum,
    learner: PPO,
    seeds: Sequence[int],
    updates: range,
    cycle: int = 3,
) -> Lived:
    """Train."""
    lived = Lived([], [], [], [], [])
    taught = TaskStudent(TASK, learner)
    for number in updates:
        if number % cycle == 0:
            streams = [Streams(seed, "cycle", number) for seed in seeds]
            metrics = {}
            if isinstance(curriculum, LearnedCurriculum):
                metrics = curriculum.improve(taught, streams)
            lived.told.append({**curriculum.log(), **metrics})
        taught.frames, taught.evaluations = 0, 0
        streams = [Streams(seed, "update", number) for seed in seeds]
        batch = curriculum.propose(taught, TASK.batch_size, streams)
        learner.env.set_levels(batch.levels)
        update = learner.update([stream.generator("actions") for stream in streams])
        curriculum.observe(taught, batch, outcome_of(update.rollout))
        for entries, entry in zip(
            lived, (batch.levels, taught.frames, taught.evaluations, update), strict=False
        ):
            entries.append(entry)
    return lived
