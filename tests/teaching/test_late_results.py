"""Results that come late, in parts, with logs in between, or never; and what holds them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._pytree import tree_map_only

import proposer_rl as prl
from proposer_rl.settings import ArgumentError
from tests.curricula.test_contract import same
from tests.teaching.counting import ITEMS, Counting, rollout, through_torch

SPACE = prl.Parameters({"force": (0.5, 4.5)}, bins=4, target={"force": 4.5})


@pytest.mark.parametrize("resumed", [False, True])
def test_an_episode_may_be_longer_than_rollouts(resumed: bool) -> None:
    """It lasts ten steps; the rollouts in which it does not end are of it, too."""
    curriculum = Counting("rollout")
    teacher = prl.Teacher(curriculum, ITEMS)
    ids, _ = teacher.ask(1)
    for steps in (4, 4, 2):
        level = ids.expand(1, steps).unsqueeze(-1)
        teacher.observe(rollout(torch.ones(1, steps), ends=steps == 2, level_id=level))
        if resumed:
            state = through_torch(teacher.state_dict())
            teacher = prl.Teacher(curriculum, ITEMS)
            teacher.load_state_dict(state)
    teacher.propose(1)
    assert curriculum.seen[0][0] == 10


def asked(every: int | None) -> tuple[list[Any], prl.Teacher]:
    """Levels of episodes one by one, logs in between, and the teacher."""
    teacher = prl.Teacher("model_transport", SPACE, block=64)
    levels = []
    for i in range(321):
        ticket, level = teacher.ask()
        levels.append(level)
        if i < 320:
            teacher.tell(ticket, float(level["force"] < 2 + i / 1000))
        if every and i % every == 0:
            teacher.log()
    return levels, teacher


def test_logs_change_nothing() -> None:
    (levels, teacher), (logged, often) = asked(None), asked(4)
    assert levels == logged
    model, other = (one.curriculum._model.state_dict() for one in (teacher, often))
    assert same(model, other)
    assert sum(len(batch["return"]) for batch in model["batches"]) == 320


def test_all_that_comes_between_two_proposals_is_one_batch_of_the_model() -> None:
    """Else a few late results would push out whole batches, of which it keeps some fifty."""
    teacher = prl.Teacher("model_transport", SPACE, block=8)
    ids = torch.cat([teacher.ask(8)[0] for _ in range(60)])
    teacher.tell(ids[::8], torch.arange(60.0))
    teacher.propose(1)
    teacher.tell(ids[1::8], torch.arange(60.0))
    teacher.propose(1)
    batches = teacher.curriculum._model.state_dict()["batches"]
    assert [batch["return"].tolist() for batch in batches] == [[*range(60)]] * 2


def test_a_score_is_told_of_all_levels_or_of_none() -> None:
    def teacher() -> prl.Teacher:
        return prl.Teacher(prl.curricula.plr(capacity=16, fill=0.5), prl.Items(16), block=8)

    first = teacher()
    ids, _ = first.ask(8)
    first.tell(ids[:7], [0.0] * 7, score=[5.0] * 7)
    for tickets in (7, ids[7:]):
        with pytest.raises(ArgumentError, match=r"score: missing: other levels were told with one"):
            first.tell(tickets, 0.0)
    resumed = teacher()
    resumed.load_state_dict(through_torch(first.state_dict()))
    with pytest.raises(ArgumentError, match="score: missing"):
        resumed.tell(7, 0.0)
    first.tell(7, 0.0, score=5.0)  # what was refused counts nothing
    first.propose(1)
    assert first.log()["mean_score"] == 5.0
    second = teacher()
    second.tell(second.ask()[0], 0.0)
    with pytest.raises(ArgumentError, match="score: others had none; give it for all or for none"):
        second.tell(second.ask()[0], 0.0, score=5.0)


def test_tickets_that_are_never_told_keep_their_own_blocks_alone() -> None:
    curriculum = Counting()
    teacher = prl.Teacher(curriculum, ITEMS, block=16)
    lost, _ = teacher.ask(4)
    for _ in range(100):
        ids, levels = teacher.ask(16)
        teacher.tell(ids, levels.double())
    blocks = teacher._ledger.blocks
    assert len(blocks) <= 3 and blocks[0].start == 0
    teacher.tell(lost[:2], [0.0, 1.0])  # one may still come back
    resumed = prl.Teacher(curriculum, ITEMS, block=16)
    resumed.load_state_dict(through_torch(teacher.state_dict()))
    resumed.drop()
    for ticket in (int(lost[3]), lost[3:]):
        with pytest.raises(ArgumentError, match="ids=3: is over"):
            resumed.tell(ticket, 0.0)
    resumed.ask(32)
    assert all(block.start > 0 for block in resumed._ledger.blocks)
    assert {n: total for n, (total, _) in curriculum.seen.items()} == {
        n: float(n) for n in range(1604) if n not in (2, 3)
    }


@pytest.mark.parametrize("dropped", [True, False])
def test_batches_whose_tickets_are_over_are_not_waited_for(dropped: bool) -> None:
    teacher = prl.Teacher(Counting(), ITEMS, block=8)
    teacher.propose(4)
    if dropped:
        teacher.drop()
    else:
        teacher.tell(range(4), [0.0] * 4)
    teacher.ask()  # takes in what was told, so that the batch is forgotten
    with pytest.raises(ArgumentError, match="ids: missing: nothing is out"):
        teacher.observe({"return": [0.0] * 4})
    first = 4 + 8
    teacher.propose(3)
    teacher.drop(range(first, first + 3))
    teacher.propose(2)
    teacher.observe({"return": [0.0] * 2})


class Elsewhere(torch.Tensor):
    """On another device: NumPy has no access to it."""

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), more: Any = None) -> Any:
        if function is torch.Tensor.numpy:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        if function is torch.Tensor.cpu:
            return args[0].as_subclass(torch.Tensor)
        return super().__torch_function__(function, types, args, more or {})


def test_a_state_may_have_been_mapped_to_another_device() -> None:
    """Against one that was not; what is pretended here is ``map_location="cuda"``."""
    recipe = prl.curricula.plr(capacity=16, fill=0.5)
    teacher = prl.Teacher(recipe, ITEMS, block=8)
    for _ in range(4):
        ids, levels = teacher.ask(6)
        teacher.tell(ids[1:], levels[1:].double())
    state = through_torch(teacher.state_dict())
    other = prl.Teacher(recipe, ITEMS, block=8)
    other.load_state_dict(tree_map_only(torch.Tensor, lambda x: x.as_subclass(Elsewhere), state))
    assert same(teacher.state_dict(), other.state_dict())
    assert all((teacher.ask(9)[i] == other.ask(9)[i]).all() for i in (0, 1))


def test_numbers_may_be_of_any_kind() -> None:
    """One level as a number or an element, counts of NumPy's, and one number for all tickets."""
    curriculum = Counting()
    teacher = prl.Teacher(curriculum, ITEMS, seed=np.int64(3), block=4)
    ids, _ = teacher.ask(np.int64(8))
    teacher.tell(ids[0], torch.tensor(0.5))
    teacher.tell(np.int64(1), 1.5)
    teacher.tell([2], 2.5)
    teacher.tell(ids[:0], [])
    half = torch.tensor([3.5, 4.5, 5.5], dtype=torch.bfloat16, requires_grad=True)
    teacher.tell(ids[3:6], half, episodes=8, steps=torch.tensor(3))
    teacher.drop(ids[6])
    assert len(teacher.propose(np.int64(3))) == 3
    assert [total for total, _ in curriculum.seen.values()] == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5]
    with pytest.raises(ArgumentError, match=r"ids=7\.0: must be whole numbers"):
        teacher.tell(torch.tensor(7.0), 0.0)
    with pytest.raises(ArgumentError, match=r"seed=1\.5: must be a whole number"):
        prl.Teacher(Counting(), ITEMS, seed=1.5)  # type: ignore[arg-type]


def test_one_number_of_episodes_stands_for_all_tickets() -> None:
    seen = []

    class Spy(Counting):
        def observe(self, student: Any, batch: Any, outcome: Any) -> None:
            seen.append([outcome[name].tolist() for name in ("return", "episodes", "steps")])

    teacher = prl.Teacher(Spy(), ITEMS)
    ids, _ = teacher.ask(3)
    teacher.tell(ids[:2], [1.0, 2.0], episodes=8)
    teacher.tell(int(ids[2]), 5.0, episodes=7)
    teacher.propose(1)
    assert seen == [[[1, 2, 5], [8, 8, 7], [1] * 3]]


@pytest.mark.parametrize("how", ["propose", "ask(n)", "ask()", "play"])
def test_a_loop_may_change_the_levels_that_it_gets(how: str) -> None:
    """As where it scales them in place: the curriculum remembers what it has proposed."""

    def play(levels: torch.Tensor, generator: Any) -> dict[str, Any]:
        return {"return": levels.fill_(9).sum(1)}

    space = prl.LevelGenerator(lambda n, g: torch.rand(n, 3, generator=g))
    if how == "play":
        teacher = prl.Teacher(prl.curricula.robust_plr(capacity=8), space, play=play)
    else:
        recipe = prl.curricula.plr(capacity=8, fill=1.0, replay_probability=1.0)
        teacher = prl.Teacher(recipe, space, block=8)
        if how == "propose":
            teacher.propose(8).fill_(9)
            teacher.observe({"return": torch.arange(8)})
        elif how == "ask(n)":
            ids, levels = teacher.ask(8)
            levels.fill_(9)
            teacher.tell(ids, torch.arange(8))
        else:
            for i in range(8):
                ticket, level = teacher.ask()
                level.fill_(9)
                teacher.tell(ticket, i)
    assert (teacher.propose(8) < 1).all()
