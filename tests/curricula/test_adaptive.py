"""The adaptive mixture: its shares by hand, its bridge by brute force, scripted students.

What a student does is a function of the level alone or of a skill, so that what is right is known.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import permutations
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import settings as profile
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

import proposer_rl as prl
from proposer_rl.curricula import AdaptiveMixture, Batch, Curriculum, SamplingCurriculum, Student
from proposer_rl.curricula.adaptive import (
    BRIDGE,
    FLOOR,
    HIGH,
    LARGE,
    LOW,
    TARGET,
    UNIFORM,
    allotted,
    assigned,
    together,
)
from proposer_rl.curricula.contract import proposed
from proposer_rl.streams import Streams
from proposer_rl.task import level_inputs

LINE = prl.Parameters({"x": (0.0, 1.0)}, target={"x": 1.0})
Reached = dict[str, Tensor]
Plays = Callable[[Any, torch.Generator], Reached]


def teach(
    curriculum: Curriculum, play: Plays, updates: int, count: int = 32, first: int = 0
) -> list[Any]:
    """Returns what was proposed, [n], and what came of it, batch by batch."""
    seen = []
    for number in range(first, first + updates):
        batch = proposed(curriculum, Student(), count, Streams(0, number))
        outcome = TensorDict(play(batch.levels, torch.Generator().manual_seed(number)), [count])
        curriculum.observe(Student(), batch, outcome)
        seen.append((batch, outcome))
    return seen


def following(curriculum: Curriculum, count: int = 32) -> tuple[Batch, dict[str, Any]]:
    """Returns the next batch, and what is logged then."""
    batch = curriculum.propose(Student(), count, Streams(1, 0))
    return batch, json.loads(json.dumps({**curriculum.log(), "levels": 0}, allow_nan=False))


def below(limit: float) -> Plays:
    """Success exactly below a place."""

    def play(levels: Any, generator: torch.Generator) -> Reached:
        won = (levels["x"] < limit).double()
        return {"return": won - levels["x"] / 8, "success": won}

    return play


def covariances(a: Tensor, b: Tensor, weight: Tensor) -> tuple[float, float, float]:
    """Returns the covariance of two variables, and the variance of each, from NumPy."""
    found = np.cov(a.numpy(), b.numpy(), aweights=weight.numpy(), ddof=0)
    return float(found[0, 1]), float(found[0, 0]), float(found[1, 1])


def by_hand(seen: list[Any], told: bool) -> list[float]:
    """Returns the shares after a history, from weights by age: the module's formulas."""
    returns = torch.cat([outcome["return"] for _, outcome in seen])
    rows: list[tuple[float, int, float, float, float]] = []  # batch, arm, label, predicted, return
    every_return: list[float] = []
    best = []
    for number, (batch, outcome) in enumerate(seen):
        came = outcome["return"].tolist()
        every_return = sorted([*every_return, *came])
        few = len(every_return) // 1000
        low, high = every_return[few], every_return[-1 - few]
        labels = [min(max((one - low) / (high - low), 0), 1) for one in came]
        if told:
            labels = outcome["success"].tolist()
        arms, predicted = (batch.notes[name].tolist() for name in ("arm", "predicted"))
        rows += zip([number] * len(arms), arms, labels, predicted, came, strict=True)
        own = [(2 ** ((r[0] - number) / 6), r[2]) for r in rows if r[1] == TARGET]
        best.append(sum(w * won for w, won in own) / (sum(w for w, _ in own) + 4))
    age = [len(seen) - 1 - row[0] for row in rows]
    weight = torch.tensor([2 ** (-one / 6) for one in age], dtype=torch.float64)
    arm, label, guess = torch.tensor([row[1:4] for row in rows], dtype=torch.float64).unbind(1)

    def variance(values: Tensor, some: Tensor) -> float:
        share = weight * some / (weight * some).sum()
        return float((share * (values - (share * values).sum()).square()).sum())

    every, uniform = torch.ones_like(weight), (arm == UNIFORM).double()
    signal = math.sqrt(variance(returns, (arm == TARGET).double()) / variance(returns, every))
    b = max(2 ** (-(len(seen) - 1 - i) / 20) * one for i, one in enumerate(best))
    covered, predicted_square, label_square = (
        float((weight * uniform).sum()) * one for one in covariances(guess, label, weight * uniform)
    )
    skill = covered / math.sqrt((predicted_square + 0.05) * (label_square + 0.5))
    low = FLOOR + (LOW - FLOOR) * min(2 * signal, 1)
    half, q = 0.1 if told else 0.5, min(max(0.4 + skill / 2, 0.2), 0.8)
    if told:
        uniform_dense, target_dense = (
            min(
                4
                * math.sqrt(variance(returns, (arm == i) * (1 - label)) / variance(returns, every)),
                1,
            )
            for i in (UNIFORM, TARGET)
        )
        solved = float((weight * uniform * label).sum() / (weight * uniform).sum())
        c = min(max((0.4 - solved) / 0.2, 0), 1) * (1 - uniform_dense)
        low, q = low + c * (0.05 - low), q + c * (0.95 - q)
        half = 0.4 - 0.3 * max(target_dense, uniform_dense)
    t = low + (HIGH - low) * b / (b + half)
    return [t, (1 - t) * (1 - q), (1 - t) * q]


@pytest.mark.parametrize(
    ("told", "scale"),
    [(False, 1), (True, 0.3), (True, 1)],
)
def test_shares_are_those_of_the_formulas(told: bool, scale: float) -> None:
    """A target that is solved a little at times, not at all in between, and always in the end."""

    def play(levels: Any, generator: torch.Generator) -> Reached:
        x = levels["x"]
        limit = 1.1 if now == 1 else 0.3 + now / 40 if now < 12 else 1.4
        won = (x + 0.3 * torch.rand(len(x), generator=generator) < limit).double()
        return {"return": 3 * won - scale * x, **({"success": won} if told else {})}

    curriculum, seen = AdaptiveMixture(LINE, LINE.target), []
    for now in range(16):
        seen += teach(curriculum, play, 1, 24 if told else 70, now)  # more than a thousand in all
        log = following(curriculum)[1]
        expected = by_hand(seen, told)
        shares = [log["shares"][arm] for arm in ("target", "uniform", "bridge")]
        assert shares == pytest.approx(expected, abs=1e-9)


@profile(max_examples=25)
@given(st.lists(st.floats(0, 1), min_size=3, max_size=3).filter(any), st.integers(0, 50))
def test_numbers_of_the_arms_are_as_the_shares(raw: list[float], count: int) -> None:
    shares = torch.tensor(raw, dtype=torch.float64) / sum(raw)
    drawn = [allotted(shares, count, torch.Generator().manual_seed(i)) for i in range(200)]
    assert all((arms.diff() >= 0).all() and len(arms) == count for arms in drawn)
    numbers = torch.stack([arms.bincount(minlength=3) for arms in drawn]).double()
    assert ((numbers - shares * count).abs() < 1 + 1e-9).all()
    assert ((numbers.mean(0) - shares * count).abs() < 0.18).all()  # five standard errors


def test_assignments_cost_as_little_as_the_best_of_all() -> None:
    for seed in range(10):
        costs = torch.rand(3, 6, generator=torch.Generator().manual_seed(seed)).double()
        best = min(costs[range(3), list(p)].sum() for p in permutations(range(6), 3))
        found = assigned(costs)
        assert len(set(found.tolist())) == 3
        assert float(costs[range(3), found].sum()) == pytest.approx(float(best))


@pytest.mark.parametrize(
    ("sizes", "parts", "expected"),
    [
        ([64, 64], [20, 30], [(20, 20 / 64), (30, 30 / 64)]),
        ([1000, 1000, 1000], [500, 400, 200], [(900, 0.9), (200, 0.2)]),
        ([1000, 1000, 64], [1000, 1, 5], [(1000, 1.0), (1, 0.001), (5, 5 / 64)]),
    ],
)
def test_parts_of_large_batches_are_learned_from_together(
    sizes: list[int], parts: list[int], expected: list[tuple[int, float]]
) -> None:
    numbers = torch.arange(sum(parts)).split(parts)
    came = [{"size": size, "return": number} for size, number in zip(sizes, numbers, strict=True)]
    joined = together(came)
    assert [(len(part["return"]), pytest.approx(share)) for part, share in joined] == expected
    assert torch.cat([part["return"] for part, _ in joined]).equal(torch.arange(sum(parts)))


@pytest.mark.parametrize("count", [64, 8 * LARGE])
def test_the_way_is_mastered_and_nearer_to_the_target_than_uniform_levels(count: int) -> None:
    """Also where thousands are assigned in blocks: none of them comes twice."""
    curriculum = AdaptiveMixture(LINE, LINE.target)
    teach(curriculum, below(0.5), 12)
    batch, _ = following(curriculum, count)
    arm, p, x = batch.notes["arm"], batch.notes["predicted"], batch.levels["x"]
    assert len(x[arm == BRIDGE].unique()) == (arm == BRIDGE).sum() > count / 8
    assert (p[arm == BRIDGE] >= 0.3 - 1e-9).all()
    assert (x[arm == TARGET] == 1).all()
    assert float(x[arm == BRIDGE].mean()) > 0.35 > float(x[arm == BRIDGE].amin())
    assert float(x[arm == BRIDGE].amax()) < 0.7 < float(x[arm == UNIFORM].amax())


def test_where_too_few_are_mastered_the_best_take_their_place() -> None:
    curriculum = AdaptiveMixture(LINE, LINE.target)
    teach(curriculum, below(0.02), 12)
    batch, _ = following(curriculum, 512)
    arm, p = batch.notes["arm"], batch.notes["predicted"]
    assert (p < 0.5).all() and p[arm == BRIDGE].mean() > 1.3 * p[arm == UNIFORM].mean()


def shares_after(play: Plays, space: Any = LINE, updates: int = 12) -> dict[str, float]:
    target = space.distributions.get("target")
    curriculum = AdaptiveMixture(space, target)
    teach(curriculum, play, updates)
    log = following(curriculum)[1]
    shares: dict[str, float] = log["shares"]
    assert sum(shares.values()) == pytest.approx(1) and min(shares.values()) >= 0
    return shares


def test_the_target_gets_little_while_it_is_silent_and_nearly_all_when_solved() -> None:
    assert shares_after(below(0.5))["target"] == pytest.approx(FLOOR, abs=1e-6)
    assert 0.6 < shares_after(below(2.0))["target"] < HIGH

    def loud(levels: Any, generator: torch.Generator) -> Reached:
        noise = torch.rand(len(levels), generator=generator)
        return {"return": noise, "success": torch.zeros(len(levels))}

    assert shares_after(loud)["target"] == pytest.approx(LOW)


def test_a_learner_that_returns_the_same_for_ever_harms_nothing() -> None:
    for told in (False, True):
        for same in (0.0, -200.1):

            def play(levels: Any, generator: torch.Generator) -> Reached:
                every = torch.full((len(levels),), same)  # noqa: B023
                return {"return": every, **({"success": 0 * every} if told else {})}  # noqa: B023

            shares = shares_after(play)
            assert min(shares.values()) > 0.04


def test_returns_alone_tell_what_is_mastered_and_where_success_is_rare_too() -> None:
    """Returns fall with x; success is not told, or there is none."""

    def play(levels: Any, generator: torch.Generator) -> Reached:
        fell = -levels["x"] - 0.1 * torch.rand(len(levels), generator=generator)
        return {"return": fell, **({"success": torch.zeros(len(levels))} if told else {})}

    for told in (False, True):
        curriculum = AdaptiveMixture(LINE, LINE.target)
        teach(curriculum, play, 12)
        batch, _ = following(curriculum, 64)
        p, x = batch.notes["predicted"], batch.levels["x"]
        assert torch.corrcoef(torch.stack([p, x]))[0, 1] < -0.8
        if told:  # as half of a success at most
            assert float(p.max()) < 0.6


@pytest.mark.parametrize("wrong", [-1e6, 1e6])
def test_an_episode_that_went_wrong_does_not_make_all_others_look_alike(wrong: float) -> None:
    """What is believed of levels, whose returns are x, some updates after one that was not."""

    def play(levels: Any, generator: torch.Generator) -> Reached:
        reached = levels["x"].clone()
        if now == 1:
            reached[3] = wrong
        return {"return": reached}

    curriculum = AdaptiveMixture(LINE, LINE.target)
    for now in range(12):
        teach(curriculum, play, 1, 256, now)
    batch, _ = following(curriculum, 512)
    some = batch.notes["arm"] == UNIFORM
    p, x = batch.notes["predicted"][some], batch.levels["x"][some]
    assert float(p.std()) > 0.6 * float(x.std()) > 0.1
    assert torch.corrcoef(torch.stack([p, x]))[0, 1] > 0.9


def draw(n: int, generator: torch.Generator) -> Tensor:
    return torch.rand(n, 2, generator=generator)


def test_inputs_that_are_no_numbers_are_refused() -> None:
    space = prl.LevelGenerator(draw, features=lambda levels: levels / 0)
    with pytest.raises(ValueError, match=r"^inputs: \d+ of \d+ numbers are not finite$"):
        prl.Teacher("adaptive_mixture", space).propose(8)


def far(levels: Tensor) -> Any:
    return levels.sum(-1, keepdim=True).sub(1).tolist()


def test_a_belief_gets_what_is_known_of_levels() -> None:
    """Features where there are; else parameters, or nothing: places in a list say nothing."""
    table = torch.tensor([[0.0, 5.0], [1.0, 5.0], [2.0, 7.0]])
    values = {"x": (0.0, 4.0), "n": [1, 2, 9], "t": ["a", "b", "c"]}
    plain = prl.Parameters(values, bins=1)
    make = lambda values, g: torch.stack([values["x"], values["n"].double()], -1)  # noqa: E731
    g = torch.Generator().manual_seed(0)
    for space, width in (
        (prl.Items(3), 0),
        (prl.Items(3, features=table), 2),
        (prl.LevelGenerator(draw), 0),
        (prl.LevelGenerator(draw, features=far), 1),
        (plain, 5),
        (prl.MadeLevels(values, make), 5),
        (prl.MadeLevels(values, make, features=far), 1),
    ):
        levels: Any = torch.stack([space.sample(6, g) for _ in range(2)])
        known = level_inputs(space, levels)
        assert known.shape == (2, 6, width) and known.dtype == torch.float64
        if width == 1:
            torch.testing.assert_close(
                known[..., 0], space.given(levels).sum(-1).double() - 1, rtol=1e-6, atol=1e-6
            )
        if width == 2:
            ranks = torch.tensor([[-2.0, -1], [0, -1], [2, 2]]).div(3).double()
            torch.testing.assert_close(known.double(), ranks[levels["item"]], atol=1e-6, rtol=0)
    known = level_inputs(plain, levels := plain.sample(40, g))
    ends = 2 * torch.stack([levels["x"] / 4, (levels["n"] - 1) / 8], -1) - 1
    torch.testing.assert_close(known[:, :2], ends.double())
    assert (known[:, 2:] == torch.eye(3)[levels["t"]]).all()


def test_items_are_remembered_one_by_one() -> None:
    """Of 5,000 items without features those that failed lately are hardly in the bridge."""
    space = prl.Items(5000, target=list(range(20)))
    curriculum = AdaptiveMixture(space, space.target)

    def odd(levels: Any, generator: torch.Generator) -> Reached:
        won = (levels["item"] % 2).double()
        return {"return": won, "success": won, "episodes": torch.full_like(won, 8)}

    seen = [batch.levels["item"] for batch, _ in teach(curriculum, odd, 30, 256)]
    batch, log = following(curriculum, 2048)
    arm, item, p = batch.notes["arm"], batch.levels["item"], batch.notes["predicted"]
    known = torch.isin(item, torch.cat(seen))
    failed = torch.isin(item, torch.cat(seen[-10:])) & (item % 2 == 0)
    bridge, uniform = (float(failed[arm == one].double().mean()) for one in (BRIDGE, UNIFORM))
    assert bridge < 0.7 * uniform  # of what failed long ago a few are tried again
    assert p[known & (item % 2 == 1)].mean() > p[~known].mean() > p[known & (item % 2 == 0)].mean()
    assert (item[arm == TARGET] < 20).all()
    assert log["shares"]["bridge"] > 0


PARTS: dict[str, Any] = {
    "range": (-2.0, 5.0),
    "whole": range(-3, 40),
    "values": [0.5, 1.0, 7.0],
    "whole values": [1, 2, 30],
    "texts": ["a", "b", "c"],
    "one": [4],
}


@profile(max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.025, 2.0]), st.booleans())
def test_levels_between_two_lie_between_them_and_within_the_space(
    seed: int, noise: float, bins: bool
) -> None:
    space = prl.Parameters(PARTS, bins=3 if bins else 1)
    g = torch.Generator().manual_seed(seed)
    a, b = space.sample(20, g), space.sample(20, g)
    between = space.between(a, b, noise, g)
    assert {name: one.dtype for name, one in between.items()} == {n: a[n].dtype for n in PARTS}
    for name, part in PARTS.items():
        low, high = torch.minimum(a[name], b[name]), torch.maximum(a[name], b[name])
        value = between[name]
        if name == "texts":
            assert ((value == a[name]) | (value == b[name])).all()
        elif not noise:
            assert ((value >= low) & (value <= high)).all()
        if name != "range":
            known = torch.arange(3) if name == "texts" else torch.tensor([*part])
            assert torch.isin(value, known.to(value)).all()
        else:
            assert ((value >= -2) & (value <= 5)).all()
    assert noise or (space.between(a, a, 0.0, g) == a).all()


MANY = {f"p{i}": (0.0, 1.0) for i in range(12)}


@pytest.mark.parametrize(
    "space",
    [
        prl.Parameters(PARTS, target={"range": 5.0, "texts": "c"}),
        prl.Parameters(PARTS, target={"range": 5.0}, seeded=True),
        prl.Parameters(MANY, bins=1, target=dict.fromkeys(MANY, 1.0)),
        LINE,
        prl.Parameters({"x": (0.0, 1.0)}),
        prl.Items(9),
        prl.Items(9, features=torch.eye(9), target=[3]),
        prl.LevelGenerator(draw),
        prl.LevelGenerator(draw, features=far, target=lambda n, g: torch.ones(n, 2)),
        prl.MadeLevels({"x": (0.0, 1.0)}, lambda v, g: v["x"].unsqueeze(-1), target={"x": 1.0}),
    ],
    ids=lambda space: type(space).__name__,
)
def test_any_space_will_do_with_a_target_or_without(space: Any) -> None:
    """Results come late, out of order, in parts of two batches, and not all of them."""
    teacher, late = prl.Teacher("adaptive_mixture", space, block=16), []
    for number in range(6):
        late += reversed(teacher.ask(24)[0].tolist())
        ids, late = late[:: 2 + number % 2], late[1::4]
        won = torch.rand(len(ids), generator=torch.Generator().manual_seed(number)).round()
        teacher.tell(ids, won, success=won)
        late = [one for one in late if one not in ids]
    teacher.propose(24)
    shares = teacher.log()["shares"]
    assert ("target" in space.distributions) == (shares["target"] > 0)
    assert sum(shares.values()) == pytest.approx(1)


class Learner:
    """Skill grows by levels at its frontier, or by the target alone; success is a matter of it."""

    def __init__(self, only_target: bool) -> None:
        self.skill, self._only_target = 0.0, only_target

    def __call__(self, levels: Any, generator: torch.Generator) -> Reached:
        x = levels["x"]
        if self._only_target:
            p = torch.where(x == 1, 0.05 + 0.95 * self.skill, 0.5)
            taught = 0.08 * (x == 1) * (1 - self.skill)
        else:
            p = ((self.skill - x) / 0.04).sigmoid()
            taught = 0.15 * 4 * p * (1 - p)
        won = (torch.rand(len(x), generator=generator) < p).double()
        self.skill += float(taught.mean())
        return {"return": won, "success": won}


def updates_until(curriculum: Curriculum, only_target: bool, skill: float, most: int) -> int:
    """Returns the number of updates until a skill is reached."""
    learner = Learner(only_target)
    for number in range(most):
        teach(curriculum, learner, 1, first=number)
        if learner.skill >= skill:
            return number + 1
    return most


def compared(only_target: bool, skill: float, most: int) -> list[int]:
    made = AdaptiveMixture(LINE, LINE.target), SamplingCurriculum(LINE)
    alone = SamplingCurriculum(LINE.target)
    return [updates_until(one, only_target, skill, most) for one in (*made, alone)]


def test_where_skill_grows_at_its_frontier_it_beats_uniform_levels_and_the_target() -> None:
    adaptive, uniform, target = compared(False, 1.0, 80)
    assert adaptive < 0.7 * uniform and adaptive < 0.7 * target, (adaptive, uniform, target)


def test_where_the_target_alone_teaches_it_is_nearly_as_fast() -> None:
    adaptive, uniform, target = compared(True, 0.9, 120)
    assert adaptive < 2 * target < uniform, (adaptive, uniform, target)


CUBE = prl.Parameters({name: (0.0, 1.0) for name in "xyz"}, target=dict.fromkeys("xyz", 1.0))


def reached(skill: float, width: float = 0.04) -> Plays:
    """Sparse success where the largest of three numbers is below a skill."""

    def play(levels: Any, generator: torch.Generator) -> Reached:
        p = ((skill - torch.stack([*levels.values()], -1).amax(-1)) / width).sigmoid()
        won = (torch.rand(len(p), generator=generator) < p).double()
        return {"return": won, "success": won}

    return play


def test_the_bridge_is_concentrated_where_uniform_levels_are_seldom_solved() -> None:
    """Of sparse success: in one of a hundred, by a third, and in most of uniform levels."""
    found = {}
    for skill in (0.2, 0.66, 0.95):
        curriculum = AdaptiveMixture(CUBE, CUBE.target)
        teach(curriculum, reached(skill), 30)
        batch, log = following(curriculum, 64)
        solved = float(reached(skill)(batch.levels, torch.Generator())["success"].mean())
        found[skill] = log["concentration"], log["shares"]["bridge"], solved
    assert found[0.2][0] == 1 and found[0.2][1] == pytest.approx(0.95 * 0.95, abs=1e-6)
    assert 0 < found[0.66][0] < 1 and found[0.95][0] == 0
    assert found[0.2][2] > 0.5  # of a batch; 0.008 of uniform levels


@pytest.mark.parametrize("case", ["dense", "not told", "data"])
def test_nothing_is_concentrated_where_every_episode_teaches(case: str) -> None:
    space = (
        prl.Items(64, features=torch.linspace(0, 1, 64).unsqueeze(-1)) if case == "data" else CUBE
    )
    target = getattr(space, "distributions", {}).get("target")

    def play(levels: Any, generator: torch.Generator) -> Reached:
        if case == "data":
            won = (levels["item"] < 3).double()
            return {"return": won, "success": won}
        won = reached(0.2)(levels, generator)["success"]
        dense = {"return": won + torch.rand(len(won), generator=generator), "success": won}
        return dense if case == "dense" else {"return": won}

    curriculum = AdaptiveMixture(space, target)
    teach(curriculum, play, 12)
    log = following(curriculum)[1]
    shares = log["shares"]
    assert log["concentration"] == 0
    assert shares["bridge"] <= 0.8 * (1 - shares["target"]) + 1e-9


def test_the_bridge_of_levels_that_come_back_does_not_stay_on_the_easiest() -> None:
    """It gets nearly all of a batch, but its levels need be mastered no better than others."""
    kinds = prl.Parameters({"x": [*range(20)]}, target={"x": 19})

    def play(levels: Any, generator: torch.Generator) -> Reached:
        x, chance = levels["x"], torch.rand(len(levels), generator=generator)
        won = ((x < 2) | ((x == 10) & (chance < 0.4))).double()
        return {"return": won, "success": won}

    curriculum = AdaptiveMixture(kinds, kinds.target)
    teach(curriculum, play, 40)
    batch, log = following(curriculum)
    bridge = batch.levels["x"][batch.notes["arm"] == BRIDGE]
    assert log["concentration"] > 0.5 and log["shares"]["bridge"] > 0.8
    mastered = bridge[(bridge < 2) | (bridge == 10)]  # the others take the place of too few
    assert (mastered == 10).sum() >= len(mastered) / 3
