"""Filtered, Schedule and Mixed: the law of the filter's draws, what is kept, and who gets what."""

from __future__ import annotations

from itertools import permutations
from math import exp
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula import Batch, Curriculum, Filtered, Mixed, Schedule, Student
from proposer_rl.curricula.combinators import draw_without_replacement
from proposer_rl.curricula.contract import LearnedCurriculum
from proposer_rl.streams import Streams
from tests.curricula.scripted import GivenScores

INF = float("inf")


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
    every, generator = torch.tensor(logits), torch.Generator().manual_seed(count)
    found: dict[frozenset[int], int] = {}
    for _ in range(draws):
        places = frozenset(draw_without_replacement(every, count, generator).tolist())
        found[places] = found.get(places, 0) + 1
    for drawn, chance in by_enumeration(logits, count).items():
        error = (chance * (1 - chance) / draws) ** 0.5
        assert abs(found.get(drawn, 0) / draws - chance) < 5 * error, drawn


def test_what_has_no_score_is_drawn_last_and_evenly() -> None:
    logits, generator = torch.tensor([-INF, 0.0, -INF, -INF]), torch.Generator().manual_seed(0)
    index = torch.stack([draw_without_replacement(logits, 2, generator) for _ in range(6000)])
    assert (index[:, 0] == 1).all()
    counts = index[:, 1].bincount(minlength=4)
    assert counts[1] == 0 and ((counts[[0, 2, 3]] - 2000).abs() < 200).all()


class Noted(LearnedCurriculum):
    """Levels are numbers from its first on; notes what it observes, and of batches how large."""

    state = ("seen",)

    def __init__(self, first: int) -> None:
        self.first, self.seen = first, []

    def propose(self, student: Student, count: int, rng: Any) -> Batch:
        levels = torch.arange(self.first, self.first + count)
        return Batch(levels, TensorDict({"own": levels}, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        assert (batch.notes["own"] == batch.levels).all()
        self.seen.append((batch.levels.tolist(), outcome["return"].tolist(), batch.size))

    def improve(self, student: Student, rng: Any) -> dict[str, Any]:
        return {"improved": self.first}

    def log(self) -> dict[str, Any]:
        return {"seen": list(self.seen)}

    def learnt(self) -> dict[str, Any]:
        return {"first": self.first} if self.first else {}


def tell(curriculum: Curriculum, batch: Batch, places: Any) -> None:
    """Some of a batch's levels come back with their places as returns."""
    some = torch.as_tensor(places)
    told = TensorDict({"return": some.float()}, [len(some)])
    curriculum.observe(Student(), batch[some], told)


def test_parts_of_a_mixture_are_observed_by_whoever_proposed_them() -> None:
    """Also of a mixture within a schedule within the mixture, whose levels are 2 to 7."""
    parts = [Noted(10 * i) for i in range(4)]
    inner = Schedule([Mixed(parts[1:3], [1, 2])], [])
    curriculum = Mixed([parts[0], inner, parts[3]], [2, 6, 1])
    batch = curriculum.propose(Student(), 9, Streams(0))
    tell(curriculum, batch, [1, 2, 4, 7])
    tell(curriculum, batch, [0, 3, 8])
    assert [part.seen for part in parts] == [
        [([1], [1], 2), ([0], [0], 2)], [([10], [2], 2), ([11], [3], 2)],
        [([20, 23], [4, 7], 4)], [([30], [8], 1)],
    ]  # fmt: skip


def test_what_is_kept_is_observed_as_if_it_alone_had_been_proposed() -> None:
    own, numbers = Noted(0), torch.tensor([0.0, 9.0, 5.0, 1.0])
    curriculum = Filtered(own, GivenScores(numbers), times=2, temperature=1e-6)
    batch = curriculum.propose(Student(), 2, Streams(0))
    assert sorted(batch.levels.tolist()) == [1, 2]
    tell(curriculum, batch, [0, 1])
    assert own.seen == [(batch.levels.tolist(), [0, 1], 2)]


def test_a_schedule_changes_at_the_exact_batch_and_gives_back_to_whom_it_came_from() -> None:
    stages = [Noted(10 * i) for i in range(3)]
    curriculum, batches = Schedule(stages, until=[2, 3]), []
    for number in range(5):
        if number == 3:  # interrupted, and put back from its state
            state = curriculum.state_dict()
            stages = [Noted(10 * i) for i in range(3)]
            curriculum = Schedule(stages, until=[2, 3])
            curriculum.load_state_dict(state)
        improved = curriculum.improve(Student(), Streams(0))
        batches.append(curriculum.propose(Student(), 2, Streams(0)))
        assert improved == {"improved": int(batches[-1].levels[0])}
    assert [int(batch.levels[0]) for batch in batches] == [0, 0, 10, 20, 20]
    for batch in batches[::-1]:
        tell(curriculum, batch, [1])
    assert [len(stage.seen) for stage in stages] == [2, 1, 2]
    assert stages[1].seen == [([11], [1], 2)]
    assert curriculum.learnt() == {"first": 20}
    assert curriculum.log() == {"seen": stages[2].seen}


@pytest.mark.parametrize(("count", "shares"), [(8, [4, 2, 2]), (3, [2, 0, 1]), (1, [0, 1, 0])])
def test_each_curriculum_of_a_mixture_has_its_share(count: int, shares: list[int]) -> None:
    parts = [Noted(10 * i) for i in range(3)]
    curriculum = Mixed(parts, [0.5, 0.25, 0.25])
    batch = curriculum.propose(Student(), count, Streams(0))
    assert (batch.levels // 10).bincount(minlength=3).tolist() == shares
    for place in reversed(range(count)):
        tell(curriculum, batch, [place])
    for part, share in zip(parts, shares, strict=True):
        seen = sorted(level for levels, *_ in part.seen for level in levels)
        assert seen == [part.first + i for i in range(share)]
    assert curriculum.log() == {f"{i}_seen": part.seen for i, part in enumerate(parts)}
