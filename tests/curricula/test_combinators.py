"""Filtered, Schedule and Mixed: the law of the filter's draws, what is kept, and who gets what."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from math import exp
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula import (
    Batch,
    Curriculum,
    Filtered,
    Inbox,
    LearnedCurriculum,
    Mixed,
    Schedule,
    Student,
)
from proposer_rl.curricula.combinators import draw_without_replacement
from proposer_rl.streams import Streams
from tests.curricula.living import TASK
from tests.curricula.scripted import GivenScores

P, T = TASK.batch_size, 8
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


class Numbered(Curriculum):
    """Has an inbox, and takes nothing but whole batches."""

    def __init__(self) -> None:
        self.inbox = Inbox()

    def propose(self, student: Student, count: int, streams: Any) -> Batch:
        return self.inbox.batch(torch.zeros(len(streams), count))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        self.inbox.check(batch, outcome)
        self.inbox.put(batch, reached=outcome["return"])


@pytest.mark.parametrize("kept", [range(9), [1, 2, 4, 7], [8]])
def test_what_is_kept_of_a_mixture_is_a_whole_batch_of_each(kept: Sequence[int]) -> None:
    """Also of a mixture within a schedule within the mixture, whose levels are 2 to 7."""
    parts = [Numbered() for _ in range(4)]
    inner = Schedule([Mixed(parts[1:3], [1, 2])], [])
    curriculum = Mixed([parts[0], inner, parts[3]], [2, 6, 1])
    batch = curriculum.propose(Student(), 9, [Streams(0), Streams(1)])
    some = batch.keep(torch.tensor([[*kept]] * 2))
    reached = torch.tensor([[*kept]] * 2).float()
    for place in reversed(range(some.count)):  # in parts, the last one first
        told = TensorDict({"return": reached[:, [place]]}, [2, 1])
        curriculum.observe(Student(), some[:, [place]], told)
    own = range(2), range(2, 4), range(4, 8), range(8, 9)
    for part, its in zip(parts, own, strict=True):
        expected = [place for place in kept if place in its]
        taken = part.inbox.take(whole=True)
        assert [evidence["reached"][1].tolist() for evidence in taken] == [expected] * (
            len(expected) > 0
        )


class Noted(LearnedCurriculum):
    """Levels are numbers from its first on; notes what it observes."""

    trains_replicas = False

    def __init__(self, first: int) -> None:
        self.first, self.seen, self.improved = first, [], 0

    def propose(self, student: Student, count: int, streams: Any) -> Batch:
        levels = torch.arange(self.first, self.first + count).expand(len(streams), -1)
        return Batch(levels, TensorDict({"own": levels}, levels.shape))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        assert (batch.notes["own"] == batch.levels).all()
        self.seen += [batch.levels[0].tolist(), outcome["return"][0].tolist()]

    def improve(self, student: Student, streams: Any) -> dict[str, Any]:
        self.improved += 1
        return {"improved": self.first}

    def log(self) -> dict[str, Any]:
        return {"seen": list(self.seen)}

    def learnt(self) -> dict[str, Any]:
        return {"first": self.first} if self.first else {}

    def state_dict(self) -> dict[str, Any]:
        return {"seen": list(self.seen)}

    def load_state_dict(self, state: Any) -> None:
        self.seen = list(state["seen"])


def outcome(levels: Tensor) -> TensorDict:
    return TensorDict({"return": levels.float() / 2}, levels.shape)


def test_what_is_kept_is_observed_as_if_it_alone_had_been_proposed() -> None:
    own = Noted(0)
    numbers = torch.tensor([[0.0, 9.0, 5.0, 1.0]])
    curriculum = Filtered(own, GivenScores(numbers), times=2, temperature=1e-6)
    batch = curriculum.propose(Student(), 2, [Streams(0)])
    assert batch.levels.tolist() == [[1, 2]]
    curriculum.observe(Student(), batch, outcome(batch.levels))
    assert own.seen == [[1, 2], [0.5, 1.0]]


def test_a_schedule_changes_at_the_exact_batch_and_gives_back_to_whom_it_came_from() -> None:
    stages = [Noted(10 * i) for i in range(3)]
    curriculum, batches = Schedule(stages, until=[2, 3]), []
    for number in range(5):
        if number == 3:  # interrupted, and put back from its state
            state = curriculum.state_dict()
            stages = [Noted(10 * i) for i in range(3)]
            curriculum = Schedule(stages, until=[2, 3])
            curriculum.load_state_dict(state)
        improved = curriculum.improve(Student(), [Streams(0)])
        batches.append(curriculum.propose(Student(), 2, [Streams(0)]))
        assert improved == {"improved": int(batches[-1].levels[0, 0])}
    assert [int(batch.levels[0, 0]) for batch in batches] == [0, 0, 10, 20, 20]
    for batch in batches[::-1]:
        curriculum.observe(Student(), batch[:, 1:], outcome(batch.levels[:, 1:]))
    assert [len(stage.seen) // 2 for stage in stages] == [2, 1, 2]
    assert stages[1].seen == [[11], [5.5]]
    assert curriculum.learnt() == {"first": 20}
    assert curriculum.log() == {"seen": stages[2].seen}


@pytest.mark.parametrize(("count", "shares"), [(8, [4, 2, 2]), (3, [2, 0, 1]), (1, [0, 1, 0])])
def test_each_curriculum_of_a_mixture_has_its_share(count: int, shares: list[int]) -> None:
    parts = [Noted(10 * i) for i in range(3)]
    curriculum = Mixed(parts, [0.5, 0.25, 0.25])
    batch = curriculum.propose(Student(), count, [Streams(0), Streams(1)])
    whose = (batch.levels // 10)[1]
    assert whose.bincount(minlength=3).tolist() == shares and batch.count == count
    for place in reversed(range(count)):
        some = batch[:, [place]]
        curriculum.observe(Student(), some, outcome(some.levels))
    for part, share in zip(parts, shares, strict=True):
        assert sorted(level for seen in part.seen[::2] for level in seen) == [
            part.first + i for i in range(share)
        ]
    assert curriculum.log() == {f"{i}_seen": part.seen for i, part in enumerate(parts)}
