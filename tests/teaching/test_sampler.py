"""Items of data sets that a teacher proposes: in a loader, told in groups, on ranks, resumed."""

from __future__ import annotations

import json
import random
import re
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import distributed, multiprocessing
from torch.utils.data import BatchSampler

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from tests.host_reads import CountedReads
from tests.teaching.conftest import LOADERS, Install
from tests.teaching.counting import ITEMS, Counting, through_torch

REPEAT = 3


def parts(items: Any, size: int) -> Iterator[Any]:
    """Lists of so many of them."""
    each = iter(items)
    return iter(lambda: [*islice(each, size)], [])


def sampled(length: int = 8) -> tuple[Counting, prl.Teacher, prl.TeacherSampler]:
    curriculum = Counting("success")
    teacher = prl.Teacher(curriculum, ITEMS, block=2)
    return curriculum, teacher, prl.TeacherSampler(teacher, length, repeat=REPEAT)


def test_answers_come_back_in_any_order_in_parts_or_never() -> None:
    """What is missing of a group is dropped, or still out."""
    curriculum, teacher, sampler = sampled()
    answers = [(item, float(k % 2), 10.0 * item + k) for item in range(7) for k in range(REPEAT)]
    assert [*sampler][: len(answers)] == [item for item, _, _ in answers]
    random.Random(0).shuffle(answers)
    lost = [answers.pop(next(i for i, a in enumerate(answers) if a[0] == 5)) for _ in range(2)]
    lost += [answer for answer in answers if answer[0] == 6]
    answers = [answer for answer in answers if answer[0] != 6]
    for part in parts(answers, 4):
        items, success, return_ = zip(*part, strict=True)
        sampler.tell(items, success, return_)
    sampler.drop([item for item, _, _ in lost[:1]])
    sampler.tell([item for item, _, _ in lost[1:]], [None] * 4)
    teacher.propose(1)
    expected = {
        item: tuple(sum(n) / len(n) for n in zip(*(a[:0:-1] for a in answers if a[0] == item)))  # noqa: B905
        for item in range(6)
    }
    assert curriculum.seen == {item: pytest.approx(means) for item, means in expected.items()}
    assert sampler.state_dict()["out"] == {7: [7]}


TWO = [0, 0, 0, 1, 1, 1]
REFUSED: dict[str, tuple[Any, Any, str]] = {
    "an item that is not out": ([0] * 3 + [7] * 3, [1.0] * 6, "items=7: 3 answers, but only 0 are"),
    "an answer more": ([1, 0, 0, 0, 0], [1.0] * 5, "items=0: 4 answers, but only 3 are out"),
    "masked": ([0, 0, 0], np.ma.array([1.0] * 3, mask=[0, 0, 1]), "success=nan: must be from 0"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_refused_counts_nothing(what: str) -> None:
    curriculum, teacher, sampler = sampled(3)
    assert [*sampler] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    items, success, message = REFUSED[what]
    with pytest.raises(ArgumentError, match=message):
        sampler.tell(items, success)
    with pytest.raises(ArgumentError, match="return_=inf: must be finite"):
        sampler.tell([0, 0, 0], [1.0] * 3, [1.0, 1.0, torch.inf])
    sampler.tell([0, 0, 0, 1, 1, 1, 2, 2, 2], [1.0] * 9)
    teacher.propose(1)
    assert curriculum.seen == dict.fromkeys(range(3), (1.0, 1.0))


def through_json(state: Any) -> Any:
    return json.loads(json.dumps(state))


def resumed(teacher: prl.Teacher, sampler: prl.TeacherSampler) -> Any:
    states = through_torch([teacher.state_dict(), sampler.state_dict()])
    for old, new in zip(states, (made := sampled())[1:], strict=True):
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
        with pytest.raises(ArgumentError, match="items=3: 3 answers, but only 0 are out"):
            again([3] * 3, [1.0] * 3)
    assert len(teacher._ledger.blocks) == 4
    sampler.drop()
    assert not sampler.state_dict()["out"]
    teacher.propose(1)
    assert curriculum.seen.keys() == {1, 2}
    assert len(teacher._ledger.blocks) == 1  # that of this proposal


SIZES = {"length": 5, "group": 2, "repeat": 2, "rounds": 2}  # the last group is smaller


def replayed(seed: int = 0, **sizes: int) -> tuple[prl.Teacher, prl.TeacherSampler]:
    """A teacher whose draws depend on what it is told."""
    recipe = prl.curricula.plr(score="learnability", capacity=4, temperature=0.1)
    teacher = prl.Teacher(recipe, prl.Items(9), seed=seed, block=2)
    return teacher, prl.TeacherSampler(teacher, **{**SIZES, **sizes})


def rest(
    sampler: prl.TeacherSampler, place: int = 0, skip: int = 0, save: Callable[[], None] = int
) -> list[int]:
    """Items of an epoch from a place on; each answer is told when its group comes first."""
    items = []
    for at, item in enumerate(islice(sampler, skip, None), place):
        items.append(item)
        if at % 8 < (4 if at < 16 else 2):
            sampler.tell([item], [float(item % 4 == at % 2 == 0)])
        save()
    return items


def test_an_epoch_goes_on_from_every_place() -> None:
    """With what was saved there, or past what a loader skips; its order by nested loops."""
    teacher, sampler = replayed()
    states: list[Any] = []

    def save() -> None:
        whole = through_torch([teacher.state_dict(), sampler.state_dict()])
        states.append([whole[0], through_json(whole[1])])

    save()
    whole = rest(sampler, save=save)
    groups = [whole[:4:2], whole[8:12:2], whole[16:18:2]]
    assert whole == [item for g in groups for _ in range(2) for item in g for _ in range(2)]
    assert whole != [*replayed()[1]]  # what is told has an effect
    teacher, sampler = replayed()
    for place, (old, state) in enumerate(states[:-1]):
        for rewound in (False, True):
            teacher.load_state_dict(old)
            sampler.load_state_dict(state)
            if rewound:
                sampler.rewind()
            assert rest(sampler, place, rewound * place) == whole[place:]
    assert len([*sampler]) == len(whole)  # the next one
    with pytest.raises(
        ArgumentError, match="state: belongs to another sampler: rounds was 2, is 1"
    ):
        replayed(rounds=1)[1].load_state_dict(state)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # torchdata's own
@pytest.mark.parametrize("stateful", [True, False])
def test_loaders_that_go_on_find_the_place(stateful: bool, install: Install) -> None:
    """torchdata's by the sampler's state; accelerate's skips what it has had."""
    sys.path.append(
        str(install(f"torchdata==0.11.0 {LOADERS}"))
    )  # last: what is there already stays
    made: Any = import_module("torchdata.stateful_dataloader" if stateful else "accelerate")

    def batches(sampler: prl.TeacherSampler) -> Any:
        if stateful:
            return made.StatefulDataLoader(range(9), 4, sampler=sampler)
        return made.data_loader.DataLoaderShard(
            range(9), batch_sampler=BatchSampler(sampler, 4, drop_last=False)
        )

    def train(sampler: prl.TeacherSampler, loader: Any, skip: int = 0) -> Iterator[list[int]]:
        for count, batch in enumerate(loader, skip):
            if count in (0, 2):
                sampler.tell(batch, [float(item % 4 == i % 2 == 0) for i, item in enumerate(batch)])
            yield batch.tolist()

    whole = [*train(sampler := replayed()[1], batches(sampler))]
    for steps in range(1, 5):
        teacher, sampler = replayed()
        loader = batches(sampler)
        begun = [*islice(train(sampler, loader), steps)]
        states = teacher.state_dict(), loader.state_dict() if stateful else sampler.state_dict()
        teacher, sampler = replayed()
        loader = batches(sampler)
        teacher.load_state_dict(states[0])
        if stateful:
            loader.load_state_dict(states[1])
        else:
            sampler.load_state_dict(states[1])
            sampler.rewind()
            loader = made.skip_first_batches(loader, steps)
        assert [*begun, *train(sampler, loader, steps)] == whole


def of_rank(rank: int, world: int) -> list[int]:
    """What a rank's sampler draws, every second batch of which it plays, as accelerate's does.

    With groups of 8 answers, half of which are of either rank.
    """
    _, sampler = replayed(length=24, repeat=8, group=1, rounds=1)
    drawn = []
    for batch in parts(sampler, 8):
        drawn += batch
        part = slice(4 * rank, 4 * rank + 4) if world > 1 else slice(8)
        told = [float(item % 4 == i % 2 == 0) for i, item in enumerate(batch)]
        sampler.tell(batch[part], told[part])
    assert not sampler.state_dict()["out"]
    return drawn


def process(rank: int, folder: str) -> None:
    distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2
    )
    drawn = of_rank(rank, 2)
    _, sampler = replayed(length=2)
    items = [next(iter(sampler))]
    with pytest.raises(ArgumentError, match=r"success=2.0: must be from 0 to 1"):
        sampler.tell(items, [2.0 * rank])  # that of one rank is wrong
    assert not sampler.state_dict()["came"]
    sampler.drop(items)
    assert not sampler.state_dict()["came"]  # both answers, one of each rank
    _, sampler = replayed(seed=rank)
    with pytest.raises(ArgumentError, match="teacher: has drawn other items on other ranks"):
        sampler.tell([next(iter(sampler))], [1.0])
    Path(folder, f"{rank}").write_text(json.dumps(drawn))
    distributed.destroy_process_group()


def test_all_ranks_have_one_curriculum_and_refuse_together(tmp_path: Path) -> None:
    """In processes of torch.distributed; against one process that plays all of it."""
    multiprocessing.spawn(process, (str(tmp_path),), nprocs=2)
    drawn = [json.loads((tmp_path / f"{rank}").read_text()) for rank in range(2)]
    assert drawn == [of_rank(0, 1)] * 2


def test_means_of_several_answers_are_weighted_and_say_what_differed() -> None:
    """A group in parts, by hand; of one answer nobody knows whether another would differ."""
    teacher = prl.Teacher("mopps", prl.Items(4), block=4)
    sampler = prl.TeacherSampler(teacher, 4, repeat=2, sources=["a", "a", "b", "c"])
    assert not sampler.metrics()
    items = [*sampler][::2]
    assert sorted(items) == [*range(4)]
    sampler.tell([0, 0, 1, 1, 2], [1, 0, 0.25, 0.75, 1], episodes=[3, 1, 1, 1, 4])
    sampler.tell([2, 3, 3], [1, 0.5, 0.5], episodes=[4, 1, 1])
    results = teacher._ledger.blocks[0].results
    told = dict(zip(items, results["success"].tolist(), strict=True))
    assert told == {0: 0.75, 1: 0.5, 2: 1, 3: 0.5}
    counts = dict(zip(items, results["episodes"].tolist(), strict=True))
    assert counts == {0: 4, 1: 2, 2: 8, 3: 2}
    names = "success", "yield", "no_variance", "predicted"
    of = {"": (0.6875, 0.5, 0.5, 0.5), "/a": (0.625, 1, 0, 0.5)}
    of |= {"/b": (1, 0, 1, 0.5), "/c": (0.5, 0, 1, 0.5)}
    assert sampler.metrics() == {
        f"{name}{source}": of[source][place] for source in of for place, name in enumerate(names)
    }
    assert not sampler.metrics()
    assert [*sampler]
    for wrong in (0.5, torch.inf):
        with pytest.raises(ArgumentError, match=f"episodes={wrong}: must be a whole number"):
            sampler.tell([0], [1.0], episodes=[wrong])


def test_what_was_predicted_is_that_of_the_proposal_also_after_a_resume() -> None:
    """The means of Beta distributions by hand, after one group on each of two items."""
    teacher = prl.Teacher(prl.curricula.mopps(decay=1.0), prl.Items(2), block=2)
    sampler = prl.TeacherSampler(teacher, 4)
    drawn = iter(sampler)
    sampler.tell([next(drawn), next(drawn)], [0.75, 0.75], episodes=[4, 4])
    items = [next(drawn), next(drawn)]
    state = sampler.state_dict()
    again = prl.Teacher(prl.curricula.mopps(decay=1.0), prl.Items(2), block=2)
    again.load_state_dict(through_torch(teacher.state_dict()))
    sampler = prl.TeacherSampler(again, 4)
    sampler.load_state_dict(through_json(state))
    sampler.tell(items, [0, 1])
    assert sampler.metrics()["predicted"] == pytest.approx((1 + 3) / (2 + 4))


def test_a_loader_that_draws_ahead_goes_on_bit_by_bit_or_at_least_validly() -> None:
    """By the states of now, rewound; and by that of the sampler when a batch was drawn."""

    def train(sampler: prl.TeacherSampler, done: int = 0, until: int = 9) -> list[list[int]]:
        """Of a loader whose workers are three batches ahead, past those that were done."""
        batches = islice(BatchSampler(sampler, 4, drop_last=False), done, None)
        queue, seen = deque(islice(batches, 3)), []
        for _ in range(done, until):
            batch = queue.popleft()
            queue.extend(islice(batches, 1))
            sampler.tell(batch, [float(item % 4 == i % 2 == 0) for i, item in enumerate(batch)])
            seen.append(batch)
        return seen

    sizes = {"length": 36, "repeat": 1, "group": 1, "rounds": 1}
    whole = train(replayed(**sizes)[1])
    assert whole != [*parts(replayed(**sizes)[1], 4)]  # what is told has an effect
    teacher, sampler = replayed(**sizes)
    assert train(sampler, until=6) == whole[:6]
    states = through_torch([teacher.state_dict(), sampler.state_dict()])
    teacher, sampler = replayed(**sizes)
    teacher.load_state_dict(states[0])
    sampler.load_state_dict(states[1])
    sampler.rewind()
    assert train(sampler, 6) == whole[6:]

    teacher, sampler = replayed(**sizes)
    state, batches = None, []
    for count, batch in enumerate(parts(sampler, 4)):
        if count == 1:
            state = through_json(sampler.state_dict())  # two batches are out
        batches.append(batch)
        if count == 3:
            break
    sampler.tell(batches[0], [1.0] * 4)
    later = through_torch(teacher.state_dict())
    teacher, sampler = replayed(**sizes)
    teacher.load_state_dict(later)
    sampler.load_state_dict(state)
    out = sampler.state_dict()["out"]
    assert sum(map(len, out.values())) == 4
    sampler.tell(batches[1], [1.0] * 4)
    for batch in parts(sampler, 4):
        sampler.tell(batch, [1.0] * 4)
    assert not sampler.state_dict()["out"]


@pytest.mark.parametrize(("part", "delay"), [(1.0, 0), (1.0, 40), (0.5, 0), (0.27, 8)])
def test_it_is_told_once_that_most_results_are_missing(part: float, delay: int) -> None:
    """Not if they come late."""
    sampler = prl.TeacherSampler(prl.Teacher("domain_randomization", prl.Items(500)), 400)
    late: deque[int] = deque()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for batch in parts(sampler, 8):
            late += batch[: round(part * 8)]
            while len(late) > delay:
                sampler.tell([late.popleft()], [1.0])
    lines = [str(each.message) for each in caught]
    assert len(lines) == (part < 1)
    assert all(re.match(r"\d+ of \d+ items have no results yet", line) for line in lines)


def test_numbers_come_from_a_device_all_at_once() -> None:
    _, _, sampler = sampled()
    items = torch.tensor([*sampler])
    with CountedReads() as reads:
        sampler.tell(items, torch.ones(24), torch.ones(24))
    assert reads.count == 0  # each of a tensor's elements would be one
