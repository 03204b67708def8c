"""A curriculum and students who train on what it proposes, as in a run."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

from proposer_rl.curricula import Curriculum, LearnedCurriculum, TaskStudent, outcome_of
from proposer_rl.learning import PPO, Update
from proposer_rl.streams import Streams
from tests.tiny import TASK


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
                metrics = curriculum.improve(taught, streams).metrics
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


def check_it_resumes(make: Callable[[], Curriculum], after: int = 4, more: int = 3) -> None:
    """A curriculum restored from a file goes on, bit by bit, as if nothing had happened."""
    whole, learner = make(), solvers([0])
    live(whole, learner, [0], range(after))
    file = io.BytesIO()
    torch.save(whole.state_dict(), file)
    snapshot = learner.snapshot()
    expected = live(whole, learner, [0], range(after, after + more))
    file.seek(0)
    resumed, again = make(), solvers([5])
    resumed.load_state_dict(torch.load(file, weights_only=True))
    again.restore(snapshot)
    found = live(resumed, again, [0], range(after, after + more))
    for one, other in zip(expected.levels, found.levels, strict=True):
        assert (one == other).all()
    assert (expected.frames, expected.evaluations) == (found.frames, found.evaluations)
    for one, other in zip(expected.told, found.told, strict=True):
        one.pop("levels", None), other.pop("levels", None)
        assert one == other
    assert (again.snapshot() == learner.snapshot()).all()


def check_each_lives_alone(make: Callable[[], Curriculum], updates: int = 4) -> None:
    """Several Solvers in one population get what each would get alone."""
    both = live(make(), solvers([3, 4]), [3, 4], range(updates))
    for copy, seed in enumerate([3, 4]):
        alone = live(make(), solvers([seed]), [seed], range(updates))
        for together, one in zip(both.levels, alone.levels, strict=True):
            assert (together[copy] == one[0]).all()
        assert both.frames == alone.frames and both.evaluations == alone.evaluations
