"""The level buffer against hand-computed tables, a brute-force simulation and its properties."""

from __future__ import annotations

from math import inf, isfinite
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.curricula.batches import level_keys
from proposer_rl.curricula.buffer import (
    ReplayRule,
    draw_slots,
    empty_buffer,
    insert,
    rescore,
    score_weights,
)

# Five levels of a buffer; the same in every test that says "the table".
SCORE = torch.tensor([0.9, 0.1, 0.5, 0.5, -0.2], dtype=torch.float64)
AGE = torch.tensor([0, 3, 1, 4, 2])
FULL = torch.ones(5, dtype=torch.bool)
RANK = ReplayRule(temperature=1.0)
BY_SCORE = {
    "rank, T = 1": (RANK, [0.437956, 0.109489, 0.218978, 0.145985, 0.087591]),
    "rank, T = 0.3": (
        ReplayRule(temperature=0.3),
        [0.877644, 0.008639, 0.087073, 0.022538, 0.004106],
    ),
    "proportional, T = 1": (
        ReplayRule(prioritization="proportional", temperature=1.0),
        [0.45, 0.05, 0.25, 0.25, 0.0],
    ),
    "proportional, T = 0.5": (
        ReplayRule(prioritization="proportional", temperature=0.5),
        [0.613636, 0.007576, 0.189394, 0.189394, 0.0],
    ),
    "softmax of two": (
        ReplayRule(prioritization="softmax", temperature=1.0, best=2),
        [0.598688, 0.0, 0.401312, 0.0, 0.0],
    ),
}
TOGETHER = [0.306569, 0.166642, 0.183285, 0.222190, 0.121314]

rules = st.builds(
    ReplayRule,
    prioritization=st.sampled_from(["rank", "proportional", "softmax"]),
    temperature=st.floats(0.05, 20),
    best=st.none() | st.integers(1, 8),
    staleness=st.floats(0, 1),
)
scores = st.lists(st.floats(-3, 3).map(lambda x: round(x, 3)), min_size=1, max_size=12)


def close(found: Tensor, expected: list[float]) -> None:
    torch.testing.assert_close(found, torch.tensor(expected).double(), atol=6e-7, rtol=0)


@pytest.mark.parametrize("name", BY_SCORE)
def test_shares_by_score_are_those_of_the_table(name: str) -> None:
    rule, expected = BY_SCORE[name]
    close(score_weights(SCORE, FULL, rule), expected)


@given(scores, rules, st.integers(0, 4), st.randoms())
def test_empty_slots_change_nothing(values: list[float], rule: ReplayRule, more: int, random: Any):
    score = torch.tensor(values)
    known = score_weights(score, torch.ones_like(score, dtype=torch.bool), rule)
    wide = torch.tensor([*values, *[random.uniform(-5, 5) for _ in range(more)]])
    filled = torch.arange(len(wide)) < len(values)
    torch.testing.assert_close(score_weights(wide, filled, rule)[: len(values)], known)
    assert (score_weights(wide, filled, rule)[len(values) :] == 0).all()


@given(scores, rules, st.randoms())
def test_shares_are_a_distribution_that_follows_the_scores(
    values: list[float], rule: ReplayRule, random: Any
) -> None:
    score, full = torch.tensor(values), torch.ones(len(values), dtype=torch.bool)
    weight = score_weights(score, full, rule)
    assert (weight >= 0).all()
    torch.testing.assert_close(weight.sum(), torch.ones((), dtype=torch.float64))
    by_score = weight[score.argsort(dim=-1, descending=True, stable=True)]
    assert (by_score.diff() <= 1e-12).all()
    if len(set(values)) == len(values):  # else slots decide between equal scores
        order = list(range(len(values)))
        random.shuffle(order)
        torch.testing.assert_close(score_weights(score[order], full, rule), weight[order])


def levels(*numbers: int) -> TensorDict:
    """Levels [n] that are equal where their numbers are."""
    count = len(numbers)
    return TensorDict({"a": torch.tensor(numbers), "b": torch.zeros(count, 2)}, [count])


def new(numbers: list[int], score: list[float], **more: Any) -> TensorDict:
    known = {"best": score, **more}
    known = {name: torch.tensor(entry) for name, entry in known.items()}
    own = {"level": levels(*numbers), "score": torch.tensor(score)}
    return TensorDict({**own, **known}, [len(numbers)])


def filled(numbers: list[int], score: list[float], capacity: int, rule: ReplayRule) -> TensorDict:
    buffer = empty_buffer(levels(0)[0], capacity)
    insert(buffer, new(numbers, score), rule)
    return buffer


class Simulation:
    """A buffer in plain Python."""

    def __init__(self, capacity: int, rule: ReplayRule) -> None:
        self.slots: list[dict[str, Any]] = []
        self.capacity, self.rule, self.clock = capacity, rule, 0

    def shares(self) -> list[float]:
        n, t = len(self.slots), self.rule.temperature
        order = sorted(range(n), key=lambda i: (-self.slots[i]["score"], i))
        weight = [(order.index(i) + 1) ** (-1 / t) for i in range(n)]
        if len({slot["score"] for slot in self.slots}) == 1:
            weight = [1.0] * n
        age = [self.clock - slot["touched"] for slot in self.slots]
        stale = [a / sum(age) if sum(age) else 1 / n for a in age]
        rho, total = self.rule.staleness, sum(weight)
        return [(1 - rho) * w / total + rho * u for w, u in zip(weight, stale, strict=True)]

    def insert(self, batch: list[tuple[int, float]]) -> None:
        """Equal levels have the mean of their finite scores; without any they are not kept."""
        for number, _ in batch:
            self.clock += 1
            own = [score for other, score in batch if other == number]
            if not (known := [score for score in own if isfinite(score)]):
                continue
            here = {"number": number, "score": sum(known) / len(known), "touched": self.clock}
            here |= {"best": max(own), "parent": number + 77}
            there = [i for i, slot in enumerate(self.slots) if slot["number"] == number]
            if there:
                here["best"] = max(self.slots[there[0]]["best"], here["best"])
                self.slots[there[0]] = here
            elif len(self.slots) < self.capacity:
                self.slots.append(here)
            else:
                shares = self.shares()
                worst = shares.index(min(shares))
                if here["score"] > self.slots[worst]["score"]:
                    self.slots[worst] = here

    def draw(self, mark: float) -> int:
        chosen, total = 0, 0.0
        for i, share in enumerate(self.shares()):
            total += share
            if mark < total:
                chosen = i
                break
        self.clock += 1
        self.slots[chosen]["touched"] = self.clock
        return chosen


@given(st.data())
def test_it_does_what_a_plain_simulation_does(data: st.DataObject) -> None:
    capacity = data.draw(st.integers(1, 6))
    rule = ReplayRule(
        temperature=data.draw(st.sampled_from([0.1, 0.3, 1.0])),
        staleness=data.draw(st.sampled_from([0.0, 0.3, 0.9])),
    )
    plain, buffer = Simulation(capacity, rule), empty_buffer(levels(0)[0], capacity)
    for step in range(data.draw(st.integers(1, 8))):
        if plain.slots and data.draw(st.booleans()):
            generator = torch.Generator().manual_seed(step)
            marks = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
            slots = draw_slots(buffer, 3, rule, generator.manual_seed(step))
            assert slots.tolist() == [plain.draw(mark) for mark in marks]
        else:
            numbers = data.draw(st.lists(st.integers(0, 9), min_size=1, max_size=4))
            values = st.integers(-4, 4).map(lambda x: x / 4) | st.just(-inf)
            score = [data.draw(values) for _ in numbers]
            parent = [number + 77 for number in numbers]
            insert(buffer, new(numbers, score, parent=parent), rule)
            plain.insert([*zip(numbers, score, strict=True)])
        n = len(plain.slots)
        assert buffer["filled"].tolist() == [True] * n + [False] * (capacity - n)
        here = buffer[:n]
        assert here["level", "a"].tolist() == [slot["number"] for slot in plain.slots]
        for name in ("score", "touched", "best", "parent"):
            assert here[name].tolist() == [slot[name] for slot in plain.slots]
        assert len(set(here["key"].tolist())) == n  # no two equal levels


def test_rescoring_takes_means_and_never_lowers_the_best_return() -> None:
    buffer = filled([1, 2, 3], [0.1, 0.2, 0.3], 4, RANK)
    score = torch.tensor([1.0, 2.0, -torch.inf])
    best = torch.tensor([-9.0, 0.7, 0.0])
    rescore(buffer, torch.tensor([0, 0, 2]), score, best)
    assert buffer["score"][:3].tolist() == pytest.approx([1.5, 0.2, 0.3])
    assert buffer["best"][:3].tolist() == pytest.approx([0.7, 0.2, 0.3])


@given(st.data())
def test_of_many_at_once_the_best_stay(data: st.DataObject) -> None:
    """Against a sorted list: without staleness the buffer holds the best of all it was given."""
    capacity = data.draw(st.integers(1, 200))
    rule, buffer = ReplayRule(staleness=0.0), empty_buffer(levels(0)[0], capacity)
    known: dict[int, float] = {}
    seed = data.draw(st.integers(0, 2**20))
    for start in (0, 100, 300):
        draws = torch.Generator().manual_seed(seed + start)
        numbers = start + torch.randint(1, 250, (150,), generator=draws)
        score = torch.rand(250 + 300 + 1, generator=draws).double()[numbers]
        score[torch.rand(150, generator=draws) < 0.1] = -torch.inf
        finite = score.isfinite()
        given = dict(zip(numbers[finite].tolist(), score[finite].tolist(), strict=True))
        insert(buffer, new(numbers.tolist(), score.tolist()), rule)
        here = {number: given.get(number, value) for number, value in known.items()}
        fresh = [(value, number) for number, value in given.items() if number not in known]
        for value, number in sorted(fresh, reverse=True):
            if len(here) == capacity:
                least = min(here, key=here.__getitem__)
                if value <= here[least]:
                    break
                del here[least]
            here[number] = value
        known = here
        row = buffer[buffer["filled"]]
        found = dict(zip(row["level", "a"].tolist(), row["score"].tolist(), strict=True))
        assert found == pytest.approx(known)
        assert len(row["key"].unique()) == len(row) and int(buffer["clock"][0]) % 150 == 0
        assert int(row["touched"].max()) <= int(buffer["clock"][0])


def test_many_draws_at_once_follow_scores_and_ages() -> None:
    buffer = filled([1, 2, 3, 4, 5], SCORE.tolist(), 9, RANK)
    buffer["touched"][:5] = buffer["clock"][0] - AGE
    slots = draw_slots(buffer, 20_000, RANK, torch.Generator().manual_seed(0))
    expected, counts = 20_000 * torch.tensor(TOGETHER), slots.bincount(minlength=5)
    assert float(((counts - expected).square() / expected).sum()) < 18.5  # p = 0.001 at 4 degrees
    last = [20_000 - int(slots.flip(0).eq(slot).nonzero()[0]) for slot in range(5)]
    assert (buffer["touched"][:5] - 5).tolist() == last


def test_keys_tell_levels_apart() -> None:
    generator = torch.Generator().manual_seed(0)
    many = TensorDict(
        {
            "walls": torch.rand(20_000, 6, 6, generator=generator) < 0.4,
            "start": torch.randint(2, (20_000, 2), generator=generator),
            "gravity": torch.randint(3, (20_000,), generator=generator) / 7,
        },
        [20_000],
    )
    rows = torch.cat([many["walls"].flatten(1), many["start"], 7 * many["gravity"][:, None]], 1)
    assert len(level_keys(many).unique()) == len(rows.unique(dim=0))
    assert level_keys(many[:5]).equal(level_keys(many.clone())[:5])
