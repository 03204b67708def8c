"""Items of data sets that a teacher proposes: in a loader, told in groups, resumed."""

from __future__ import annotations

import io
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from tests.host_reads import CountedReads
from tests.teaching.counting import ITEMS, Counting

REPEAT = 3


def sampled(length: int = 8) -> tuple[Counting, prl.Teacher, prl.TeacherSampler]:
    curriculum = Counting("success")
    curriculum.load_state_dict = lambda state: None  # type: ignore[method-assign]
    teacher = prl.Teacher(curriculum, ITEMS, block=2)
    return curriculum, teacher, prl.TeacherSampler(teacher, length, repeat=REPEAT)


def test_a_loader_draws_groups_and_each_gets_its_mean() -> None:
    """Return and success of each item by hand; the groups come back in another order."""
    curriculum, teacher, sampler = sampled()
    loader = DataLoader(range(1000), batch_size=2 * REPEAT, sampler=sampler)  # type: ignore[arg-type]
    drawn = [batch.flip(0) for batch in loader]
    assert torch.cat(drawn).unique().tolist() == [*range(8)]
    for items in reversed(drawn):
        sampler.tell(items, torch.tensor([0.0, 1.0, 1.0] * 2), items * torch.tensor([1, 2, 3] * 2))
    teacher.propose(1)
    assert curriculum.seen == {n: (2.0 * n, pytest.approx(2 / 3)) for n in range(8)}


REFUSED: dict[str, tuple[list[int], Any, str]] = {
    "an item that is not out": ([0, 0, 0, 7, 7, 7], [1.0] * 6, "items=7: is not out"),
    "one twice that is out once": ([0] * 6, [1.0] * 6, "items=0: is not out"),
    "two in a group": ([0, 0, 0, 1, 1, 2], [1.0] * 6, "items=1: is not out"),
    "part of a group": ([0, 0, 0, 1], [1.0] * 4, "items: 4 are no groups of 3"),
    "too few results": ([0, 0, 0, 1, 1, 1], [1.0] * 5, "success: 5 results for 6 items"),
    "no share": ([0, 0, 0, 1, 1, 1], [1.0] * 3 + [9.0] * 3, "success=9: must be from 0 to 1"),
    "a mean of no shares": ([0, 0, 0], [2.0, -1.0, 0.5], "success=2: must be from 0 to 1"),
    "no numbers": ([0, 0, 0], torch.ones(3, 1), r"success: must be numbers \[n\]"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_refused_counts_nothing(what: str) -> None:
    curriculum, teacher, sampler = sampled(3)
    assert [*sampler] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    items, success, message = REFUSED[what]
    with pytest.raises(ArgumentError, match=message):
        sampler.tell(items, success)
    sampler.tell([0, 0, 0, 1, 1, 1, 2, 2, 2], [1.0] * 9)
    teacher.propose(1)
    assert curriculum.seen == dict.fromkeys(range(3), (1.0, 1.0))


def resumed(teacher: prl.Teacher, sampler: prl.TeacherSampler) -> Any:
    file = io.BytesIO()
    torch.save([teacher.state_dict(), sampler.state_dict()], file)
    file.seek(0)
    for old, new in zip(torch.load(file, weights_only=True), (made := sampled())[1:], strict=True):
        new.load_state_dict(old)
    return made


def test_what_was_out_may_be_told_after_a_resume_or_dropped() -> None:
    _, teacher, sampler = sampled()
    assert len([*sampler]) == 24
    sampler.tell([1] * 3, [1.0] * 3)
    curriculum, teacher, sampler = resumed(teacher, sampler)
    sampler.tell([2] * 3, [1.0] * 3)
    sampler.drop(torch.tensor([3] * 3))
    for again in (sampler.tell, lambda items, _: sampler.drop(items)):
        with pytest.raises(ArgumentError, match="items=3: is not out"):
            again([3] * 3, [1.0] * 3)
    assert len(teacher._ledger.blocks) == 4
    sampler.drop()
    assert not sampler.state_dict()["out"]
    teacher.propose(1)
    assert curriculum.seen.keys() == {1, 2}
    assert len(teacher._ledger.blocks) == 1  # that of this proposal


def test_numbers_come_from_a_device_all_at_once() -> None:
    _, _, sampler = sampled()
    items = torch.tensor([*sampler])
    with CountedReads() as reads:
        sampler.tell(items, torch.ones(24), torch.ones(24))
    assert reads.count == 0  # each of a tensor's elements would be one
