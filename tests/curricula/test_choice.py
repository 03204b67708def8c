"""A choice among more levels than one trains on: its law by enumeration, and what it picks."""

from __future__ import annotations

from itertools import permutations
from math import exp
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from proposer_rl.curricula import (
    Choice,
    Curriculum,
    FirstOrderCurriculum,
    LearningProgressCurriculum,
    PairedProposer,
    Proposal,
    SamplingCurriculum,
    ScheduleCurriculum,
    Scorer,
)
from proposer_rl.curricula.batches import fresh_levels
from proposer_rl.curricula.buffer import level_keys
from proposer_rl.curricula.choice import draw_without_replacement
from proposer_rl.streams import Streams
from tests.curricula.living import (
    check_a_new_life_begins,
    check_each_lives_alone,
    check_it_resumes,
    live,
    solvers,
)
from tests.curricula.scripted import GivenScores
from tests.curricula.test_paired import paired
from tests.tiny import TASK, evaluate

P, T = TASK.batch_size, 8
INF = float("inf")


def choice(source: Any = "exact", times: int = 3, temperature: float = 0.05) -> Choice:
    scorer = Scorer(TASK, "learnability", source, 2)
    return Choice(scorer, times=times, temperature=temperature)


MAKERS = {
    "of a distribution": lambda: SamplingCurriculum(TASK.space, choice()),
    "from episodes": lambda: SamplingCurriculum(TASK.space, choice("episodes")),
    "of a schedule": lambda: ScheduleCurriculum(
        [SamplingCurriculum(d, choice()) for d in (TASK.space, TASK.target)], [2]
    ),
    "of bins": lambda: FirstOrderCurriculum(
        TASK, every=1, target_levels=8, candidates=2, choice=choice()
    ),
    "of bins that are observed": lambda: LearningProgressCurriculum(
        TASK, source="episodes", choice=choice()
    ),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_it_lives_as_a_curriculum_should(make) -> None:
    check_it_resumes(make)
    check_each_lives_alone(make)
    check_a_new_life_begins(make)


def by_enumeration(logits: list[float], count: int) -> dict[frozenset[int], float]:
    """How likely each set is that is drawn one after another, without replacement."""
    weights = [exp(x) for x in logits]
    law: dict[frozenset[int], float] = {}
    for order in permutations(range(len(logits)), count):
        chance, left = 1.0, sum(weights)
        for place in order:
            chance *= weights[place] / left
            left -= weights[place]
        law[frozenset(order)] = law.get(frozenset(order), 0.0) + chance
    return law


@pytest.mark.parametrize("count", [1, 2, 3])
def test_draws_have_the_law_of_one_after_another(count: int) -> None:
    logits, draws = [0.0, 1.0, -1.0, 2.0], 20_000
    rows = torch.tensor(logits).expand(draws, -1)
    generator = torch.Generator().manual_seed(count)
    index = draw_without_replacement(rows, count, [generator] * draws)
    found: dict[frozenset[int], int] = {}
    for row in index.tolist():
        found[frozenset(row)] = found.get(frozenset(row), 0) + 1
    for drawn, chance in by_enumeration(logits, count).items():
        error = (chance * (1 - chance) / draws) ** 0.5
        assert abs(found.get(drawn, 0) / draws - chance) < 5 * error, drawn


def test_what_has_no_score_is_drawn_last_and_evenly() -> None:
    rows = torch.tensor([-INF, 0.0, -INF, -INF]).expand(6000, -1)
    generator = torch.Generator().manual_seed(0)
    index = draw_without_replacement(rows, 2, [generator] * 6000)
    assert (index[:, 0] == 1).all()
    counts = index[:, 1].bincount(minlength=4)
    assert counts[1] == 0 and ((counts[[0, 2, 3]] - 2000).abs() < 200).all()


def test_the_coldest_choice_is_the_most_learnable() -> None:
    curriculum = SamplingCurriculum(TASK.space, choice(times=8, temperature=1e-9))
    learner, streams = solvers([0, 1]), [Streams(seed, "update", 0) for seed in (0, 1)]
    proposal = curriculum.propose(learner, 0, streams)
    candidates = fresh_levels(TASK.space, 8 * P, streams, "levels")
    keys, found = level_keys(candidates), level_keys(proposal.levels)
    for copy in (0, 1):
        row = evaluate(solvers([copy]).agent, candidates[copy])["success"][0].tolist()
        best = sorted(range(8 * P), key=lambda i: -row[i] * (1 - row[i]))[:P]
        assert sorted(found[copy].tolist()) == sorted(keys[copy, best].tolist())
    assert proposal[1:] == (0, 8 * P)


def test_costs_are_those_of_the_candidates_and_of_their_scores() -> None:
    lived = live(SamplingCurriculum(TASK.space, choice("episodes")), solvers([0]), [0], range(2))
    assert lived.frames == [2 * 3 * P * T] * 2 and lived.evaluations == [0, 0]
    looks = 8 + 2 * 2 * TASK.space.size
    lived = live(MAKERS["of bins"](), solvers([0]), [0], range(2))
    assert lived.frames == [0, 0] and lived.evaluations == [looks + 3 * P] * 2


def test_places_and_levels_go_together() -> None:
    numbers = torch.tensor([[0.0, 9.0, 5.0, 1.0], [7.0, 0.0, 0.0, 8.0]], dtype=torch.float64)
    pick = Choice(GivenScores(numbers), times=2, temperature=1e-6)
    levels = torch.arange(8).view(2, 4)
    learner: Any = SimpleNamespace()
    index, proposal = pick(learner, Proposal(levels, 3, 4), [Streams(0), Streams(1)])
    assert index.tolist() == [[1, 2], [3, 0]]
    assert proposal.levels.tolist() == [[1, 2], [7, 4]]
    assert proposal[1:] == (3, 8)


def test_a_learnt_policy_is_paid_for_all_that_it_draws() -> None:
    curriculum: PairedProposer = paired(choice=choice(times=2))
    lived = live(curriculum, solvers([0]), [0], range(4))
    assert lived.evaluations == [2 * 2 * P + 2 * P] * 4
    histogram = torch.tensor(lived.told[-1]["histogram"])
    assert int(histogram.sum()) == 3 * P  # what was trained on


def test_what_is_told_is_what_was_trained_on() -> None:
    curriculum: Curriculum = MAKERS["of bins"]()
    told = live(curriculum, solvers([0, 1]), [0, 1], range(4)).told[-1]
    assert int(torch.tensor(told["histogram"]).sum()) == 3 * 2 * P


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"times": 1}, "times must be a whole number from 2 to"),
        ({"temperature": 0.0}, "temperature must be a finite number above 0, got 0.0"),
    ],
)
def test_what_makes_no_sense_is_refused(numbers: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        choice(**numbers)
