"""Sampling for learnability: what is kept is what a brute force would keep."""

from __future__ import annotations

import pytest
import torch

from proposer_rl.curricula import TaskStudent
from proposer_rl.curricula.buffer import level_keys
from proposer_rl.learning import DivergedError
from proposer_rl.streams import Streams
from tests.curricula.living import TASK, live, solvers, student
from tests.curricula.made import selection
from tests.curricula.scripted import GivenScores
from tests.tiny import evaluate

P, T = 4, 8


def test_the_best_are_kept_and_half_of_a_batch_is_drawn_from_them() -> None:
    curriculum, learner, stream = selection(), solvers([0]), Streams(0, "update", 0)
    taught = TaskStudent(TASK, learner)
    levels = curriculum.propose(taught, P, stream)
    candidates = TASK.space.sample(16, stream.generator("candidates"))
    chance = evaluate(learner.agent, candidates)["success"][0]
    worth = [float(p * (1 - p)) for p in chance]
    best = sorted(range(16), key=lambda i: -worth[i])[:6]
    keys = level_keys(candidates)
    assert level_keys(curriculum.kept).tolist() == keys[best].tolist()
    drawn = level_keys(levels).tolist()
    assert all(key in keys[best].tolist() for key in drawn[:2])
    assert (taught.frames, taught.evaluations) == (0, 16)


def test_it_selects_every_few_updates_and_says_what_that_costs() -> None:
    (lived,) = live([selection()], solvers([0]), [0], range(7))
    assert lived.evaluations == [16, 0, 0, 16, 0, 0, 16] and set(lived.frames) == {0}
    (lived,) = live([selection("episodes")], solvers([0]), [0], range(4))
    assert lived.frames == [2 * 16 * T, 0, 0, 2 * 16 * T] and set(lived.evaluations) == {0}
    told = lived.told[-1]
    assert told["highest_score"] >= told["mean_score"] >= told["lowest_kept_score"]
    assert len(told["levels"]["highest scores"]) == 6


def test_the_best_that_have_a_score_are_kept() -> None:
    """Levels without one, as where no episode ends within the horizon, are not trained on."""
    curriculum, few = selection(keep=3), torch.full((16,), -torch.inf)
    found = torch.tensor([0.0, 0.25, 0.0, 0.2, 0.0, -torch.inf, 0.1] + [0.0] * 9)
    curriculum.scorer = GivenScores(found)
    curriculum.propose(student(0), P, Streams(0))
    assert curriculum.scores.tolist() == pytest.approx([0.25, 0.2, 0.1])
    few[:2] = 0.1
    curriculum = selection(keep=3)
    curriculum.scorer = GivenScores(few)
    with pytest.raises(DivergedError, match=r"on 2 of 16 .* fewer than 3 have"):
        curriculum.propose(student(0), P, Streams(0))


@pytest.mark.parametrize(("new", "fresh"), [(0.0, 0), (1.0, 4), (0.25, 1)])
def test_the_mixture_is_exact(new: float, fresh: int) -> None:
    curriculum = selection(new=new)
    keys = level_keys(curriculum.propose(student(0), P, Streams(0)))
    kept = torch.isin(keys, level_keys(curriculum.kept))
    assert bool(kept[: P - fresh].all()) and len(keys) == P
    if fresh:
        drawn = level_keys(TASK.space.sample(fresh, Streams(0).generator("levels")))
        assert torch.equal(keys[P - fresh :], drawn)
