"""Curricula of items against their papers' formulas by hand, enumeration, and a linear filter."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from tensordict import TensorDict

import proposer_rl as prl
from proposer_rl.curricula import Curriculum, Student
from proposer_rl.curricula.items import PRIOR, ItemCurriculum, arc_length, nearest, wanted_arc
from proposer_rl.curricula.scores import mixed
from proposer_rl.streams import Streams

RATES = [0.9, 0.7, 0.5, 0.3, 0.1, 0.0]
ITEMS = prl.Items(6, features={"source": [*"aabbcc"]}, pass_rates=RATES)


def made(recipe: Any, space: Any = ITEMS) -> Any:
    return prl.Teacher(recipe, space).curriculum


def proposed(curriculum: Curriculum, count: int, number: int = 0) -> list[int]:
    batch = curriculum.propose(Student(), count, Streams(0, number))
    places: list[int] = batch.levels["item"].tolist()
    return places


def tell(
    curriculum: ItemCurriculum, right: Mapping[int, float], answers: int, number: int = 0
) -> None:
    """Tells how many answers were right to each item of the dict, once."""
    batch = curriculum.propose(Student(), 48, Streams(0, "told", number))
    drawn = batch.levels["item"].tolist()
    places = [drawn.index(item) for item in right]
    batch = batch[torch.tensor(places)]
    won = torch.tensor([right[item] / answers for item in batch.levels["item"].tolist()])
    told = {"return": won, "success": won, "episodes": torch.full_like(won, answers)}
    curriculum.observe(Student(), batch, TensorDict(told, won.shape))
    curriculum.propose(Student(), 1, Streams(0, "after", number))


def test_mopps_has_the_beta_distributions_of_its_paper() -> None:
    curriculum = made(prl.curricula.mopps(decay=0.5))
    for number, right in enumerate(({0: 8, 1: 2, 2: 4.5}, {0: 7, 3: 0}, {0: 8, 1: 2, 3: 0})):
        tell(curriculum, right, 8, number)
    a, b = (curriculum.numbers[name].tolist() for name in "ab")
    assert a == [14.5, 4.0, 5.5, 1.0, 1.0, 1.0]  # the first: 1, 9, 12, 14.5
    assert b == pytest.approx([1.5, 10.0, 4.5, 13.0, 1.0, 1.0])
    p = torch.tensor(a) / (torch.tensor(a) + torch.tensor(b))
    batch = curriculum.propose(Student(), 6, Streams(0, 9))
    torch.testing.assert_close(
        batch.notes["predicted"].float(), p[batch.levels["item"]], atol=1e-6, rtol=0
    )
    first = [proposed(curriculum, 1, n)[0] for n in range(2000)]
    draws = np.random.default_rng(0).beta(a, b, (20_000, 6))
    expected = np.bincount(np.abs(draws - 0.5).argmin(1), minlength=6) / 20_000
    assert np.bincount(first, minlength=6) / 2000 == pytest.approx(expected, abs=0.04)


def test_adarft_follows_success_with_a_difficulty() -> None:
    curriculum = made(prl.curricula.adarft(step=0.4, sensitivity=2.0, aim=0.5))
    assert set(proposed(curriculum, 2)) == {0, 1}
    difficulty = 0.1
    for number, won in enumerate((8, 8, 2, 8, 8)):
        tell(curriculum, {0: won}, 8, number)
        difficulty += 0.4 * math.tanh(2 * (won / 8 - 0.5))
        difficulty = min(max(difficulty, 0.1), 1.0)
        assert curriculum.log()["difficulty"] == pytest.approx(difficulty)
        distance = [abs(1 - rate - difficulty) for rate in RATES]
        assert set(proposed(curriculum, 3)) == {*np.argsort(distance)[:3].tolist()}


def test_sec_values_categories_by_how_much_their_groups_differ() -> None:
    curriculum = made(prl.curricula.sec(rate=0.5, temperature=0.25))
    tell(curriculum, {0: 4, 1: 2, 2: 8}, 8)
    tell(curriculum, {0: 8, 1: 8, 4: 1}, 8, 1)
    a = (2 * math.sqrt(0.25) + 2 * math.sqrt(3 / 16)) / 2 * 0.5 * 0.5
    values = [a, 0.0, math.sqrt(7 / 64)]
    assert curriculum.log()["value"] == pytest.approx(values)
    shares = np.exp(np.array(values) / 0.25)
    drawn = [place for n in range(200) for place in proposed(curriculum, 6, n)]
    found = np.bincount(drawn, minlength=6).reshape(3, 2) / 1200
    assert found.sum(1) == pytest.approx(shares / shares.sum(), abs=0.01)
    assert found[:, 0] == pytest.approx(found[:, 1], abs=0.05)


@pytest.mark.parametrize("recipe", [prl.curricula.sec(), prl.curricula.plr(score="yield")])
def test_single_answers_that_can_teach_nothing_are_named_once(recipe: Any) -> None:
    space = prl.Items(6, features={"source": [*"aabbcc"]})
    for success, answers in ((1.0, 8), (1.0, 1)):
        teacher = prl.Teacher(recipe, space, block=3)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            for _ in range(3):
                tickets, _ = teacher.ask(3)
                teacher.tell(tickets, [success] * 3, [success] * 3, episodes=answers)
        lines = [str(one.message) for one in told]
        assert len(lines) == (answers == 1)
        assert all(
            "single answer" in line and "tell episodes= of several" in line for line in lines
        )


def test_a_groups_arc_length_has_a_variance_that_does_not_depend_on_p() -> None:
    right = torch.tensor([0.0, 1, 4, 7, 8], dtype=torch.float64)
    z, error = arc_length(right, torch.full_like(right, 8))
    inner = [math.asin(math.sqrt((m + 3 / 8) / 8.75)) for m in (1, 4, 7)]
    assert z.tolist() == pytest.approx([0, *inner, math.pi / 2])
    assert error.tolist() == pytest.approx([1 / 16, *[1 / 34] * 3, 1 / 16])
    for p in (0.3, 0.5, 0.8):
        weight = stats.binom.pmf(np.arange(33), 32, p)
        z = arc_length(torch.arange(33.0).double(), torch.full((33,), 32.0).double())[0].numpy()
        mean = (weight * z).sum()
        assert (weight * (z - mean) ** 2).sum() == pytest.approx(1 / 130, rel=0.05)
        assert mean == pytest.approx(math.asin(math.sqrt(p)), abs=0.01)


def test_without_noise_the_filter_is_a_weighted_mean() -> None:
    recipe = prl.curricula.arc_length(noise=0.0, drift_noise=0.0)
    curriculum = made(recipe)
    seen = [(3, 8), (5, 8), (2, 4), (0, 8)]
    for number, (right, answers) in enumerate(seen):
        tell(curriculum, {1: right}, answers, number)
    m, g = torch.tensor(seen, dtype=torch.float64).T
    z, error = arc_length(m, g)
    precision = 1 / PRIOR + (1 / error).sum()
    psi = (math.pi / 4 / PRIOR + (z / error).sum()) / precision
    assert float(curriculum.numbers["psi"][1]) == pytest.approx(float(psi))
    assert float(curriculum.numbers["variance"][1]) == pytest.approx(float(1 / precision))
    grid = torch.linspace(-8, 8, 4001).double() / float(precision) ** 0.5 + psi
    density = (-(grid - psi).square() * precision / 2).exp()
    p = (grid.sin().square() * density).sum() / density.sum()
    assert float(curriculum.expected()[1]) == pytest.approx(float(p), abs=1e-6)


def test_one_drift_moves_the_items_that_nobody_draws() -> None:
    curriculum = made("arc_length", prl.Items(40))
    for number in range(150):
        batch = curriculum.propose(Student(), 20, Streams(0, number))
        psi = 0.2 + 0.006 * number + 0.01 * (batch.levels["item"] % 5)
        won = (psi.sin().square() * 64).round() / 64
        told = {"return": won, "success": won, "episodes": torch.full_like(won, 64)}
        curriculum.observe(Student(), batch, TensorDict(told, won.shape))
    curriculum.propose(Student(), 1, Streams(1))
    assert float(curriculum.numbers["drift"]) == pytest.approx(0.006, abs=0.002)
    expected = 0.2 + 0.006 * 149 + 0.01 * (torch.arange(40) % 5).double()
    assert (curriculum.numbers["psi"] - expected).abs().max() < 0.08
    again = made("arc_length", prl.Items(40))
    again.load_state_dict(curriculum.state_dict())
    logged = curriculum.log()
    assert "brier" in logged and again.log() == logged


@pytest.mark.parametrize("answers", [1, 2, 5])
@pytest.mark.parametrize("p", [0.0, 0.2, 0.5, 1.0])
def test_a_group_is_mixed_as_often_as_an_enumeration_says(p: float, answers: int) -> None:
    often = sum(
        math.prod(p if right else 1 - p for right in group)
        for group in product([0, 1], repeat=answers)
        if 0 < sum(group) < answers
    )
    assert float(mixed(torch.tensor(p), answers)) == pytest.approx(often, abs=1e-6)


def test_what_is_wanted_is_as_hard_as_the_slack_allows() -> None:
    for answers, slack in ((2, 0.1), (8, 0.1), (8, 0.0), (64, 0.3)):
        p = math.sin(wanted_arc(answers, slack)) ** 2
        least = (1 - slack) * (1 - 2 * 0.5**answers)
        assert 1 - p**answers - (1 - p) ** answers >= least - 1e-9
        q = p - 0.001
        assert q < 0 or 1 - q**answers - (1 - q) ** answers < least


def test_each_item_comes_once_and_all_as_often() -> None:
    g = torch.Generator().manual_seed(0)
    places = nearest(torch.tensor([0.3, -0.1, 0.2, -5.0]), 7, g)
    assert places.bincount().tolist() == [2, 2, 2, 1]
    ties = torch.stack([nearest(torch.zeros(4), 2, g) for _ in range(400)])
    assert (ties.flatten().bincount() / 200 - 1).abs().max() < 0.25
