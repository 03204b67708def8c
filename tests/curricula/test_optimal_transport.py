"""Transport to the target: against a grid over all distributions, and with scripted Solvers."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from proposer_rl.curricula.optimal_transport import (
    TransportCurriculum,
    step_towards,
)
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, build
from proposer_rl.tasks.mazes import SpecificationSpace
from proposer_rl.tasks.mazes.task import DistributionSettings, SpaceSettings
from proposer_rl.tasks.parameters import ParameterSpace, intervals
from tests.curricula.scripted import Scripted, step
from tests.tiny import tiny_task


def squared(p: np.ndarray, q: np.ndarray, places: np.ndarray) -> float:
    """W2 squared on a line, as the integral of the squared distance of the quantile functions."""
    levels = np.unique(np.concatenate([[0.0, 1.0], p.cumsum(), q.cumsum()]).round(12).clip(0, 1))
    middles = (levels[1:] + levels[:-1]) / 2
    at = [places[np.searchsorted(x.cumsum().round(12), middles)] for x in (p, q)]
    return float(((at[0] - at[1]) ** 2 * np.diff(levels)).sum())


def grid(size: int, parts: int) -> np.ndarray:
    """All distributions over bins in multiples of 1 / parts."""
    counts = [c for c in product(range(parts + 1), repeat=size) if sum(c) == parts]
    return np.array(counts) / parts


def costs_of(places: np.ndarray) -> np.ndarray:
    return (places[:, None] - places) ** 2


PLACES = [np.array([-1.0, 0.1, 1.0]), np.array([-1.0, -0.5, 0.3, 1.0])]


@pytest.mark.parametrize("places", PLACES, ids=["3 bins", "4 bins"])
@pytest.mark.parametrize("reach", [0.2, 0.5, 1.2])
@pytest.mark.parametrize("seed", range(4))
def test_no_distribution_of_a_grid_is_better(places: np.ndarray, reach: float, seed: int) -> None:
    generator = np.random.default_rng(seed)
    size = len(places)
    allowed = np.ones(size, bool)
    allowed[generator.integers(size)] = seed % 2 == 0  # with all bins, and with one less
    every = grid(size, 20)
    possible = every[(every[:, ~allowed] == 0).all(1)]
    now = possible[generator.integers(len(possible))]
    target = every[generator.integers(len(every))]
    p, left = step_towards(target, now, costs_of(places), allowed, reach)
    assert p.sum() == pytest.approx(1) and (p >= 0).all() and (p[~allowed] == 0).all()
    assert squared(p, now, places) <= reach**2 + 1e-6
    assert left == pytest.approx(squared(p, target, places), abs=1e-6)
    near = [q for q in possible if squared(q, now, places) <= reach**2]
    assert left <= min(squared(q, target, places) for q in near) + 1e-6


def test_from_bins_that_are_lost_the_nearest_ones_are_taken() -> None:
    places = np.array([-1.0, 0.0, 0.2, 1.0])
    now = np.array([0.0, 0.0, 1.0, 0.0])
    allowed = np.array([True, True, False, True])
    p, _ = step_towards(np.eye(4)[3], now, costs_of(places), allowed, 0.1)
    np.testing.assert_allclose(p, [0, 1, 0, 0], atol=1e-9)


@pytest.mark.parametrize("part", range(4))
def test_it_is_solved_whatever_the_shares(part: int) -> None:
    """Rounded numbers on the paper's grid: equations that contradict each other by 1e-16."""
    generator = np.random.default_rng(part)
    places = np.array(list(product(np.linspace(-1, 1, 6), np.linspace(-1, 1, 8))))
    costs = ((places[:, None] - places) ** 2).sum(-1)
    for number in range(40):
        target, now = generator.dirichlet(np.full(48, 0.1)), generator.dirichlet(np.full(48, 0.5))
        allowed = generator.random(48) < generator.choice([0.02, 0.1, 0.5, 1])
        allowed[number] = True
        p, left = step_towards(target, now, costs, allowed, generator.choice([0.001, 0.3, 1]))
        assert p.sum() == pytest.approx(1) and (p[~allowed] == 0).all() and (p >= 0).all()
        assert left >= costs[allowed].min(0) @ target - 1e-6


def curriculum(task: Any, **options: Any) -> TransportCurriculum:
    return TransportCurriculum(
        task.space, task.target_shares, **{"every": 1, "probes": 2, **options}
    )


@pytest.mark.parametrize(
    ("skills", "delta", "epsilon", "expected"),
    [
        ([0.0] * 5, 0.0, 5.0, [0, 3, 0, 0, 7]),  # nothing to master: the target at once
        ([0.0, 0.1, 0.3, 0.2, 0.0], 0.5, 0.4, [0, 0, 10, 0, 0]),  # nothing mastered: the best
        ([0.0] * 5, 0.5, 0.01, [2] * 5),  # where all fails, all is searched
    ],
)
def test_a_first_batch_is_drawn_from_what_is_mastered(
    skills: list[float], delta: float, epsilon: float, expected: list[int]
) -> None:
    task = Scripted(torch.tensor(skills), batch_size=10)
    task.target_shares = torch.tensor([0.0, 0.3, 0.0, 0.0, 0.7])
    found = curriculum(task, delta=delta, epsilon=epsilon)
    assert step(found, task, 0).bincount(minlength=5).tolist() == expected


def test_a_master_is_led_to_the_target_step_by_step() -> None:
    task = Scripted(torch.ones(5))
    found = curriculum(task, epsilon=0.3)
    places = task.space.coordinates[:, 0].double().numpy()
    before, distances = np.full(5, 0.2), []
    for update in range(12):
        step(found, task, update)
        now = found.shares().numpy()
        assert squared(now, before, places) <= 0.3**2 + 1e-6
        told = found.log()
        expected = squared(now, np.eye(5)[4], places) ** 0.5
        assert told["target_distance"] == pytest.approx(expected, abs=1e-6)
        distances.append(told["target_distance"])
        before = now
    assert distances == sorted(distances, reverse=True)
    assert distances[3] > 0.1 and distances[-1] == pytest.approx(0, abs=1e-5)
    np.testing.assert_allclose(before, np.eye(5)[4], atol=1e-6)


def test_only_bins_that_are_mastered_are_drawn_from_and_the_way_opens_with_them() -> None:
    task = Scripted(torch.tensor([0.9, 0.6, 0.2, 0.1, 0.0]))
    found = curriculum(task, delta=0.5, epsilon=0.4)
    for update in range(8):
        bins = step(found, task, update)
        assert (bins <= 1).all()
    assert (bins == 1).all()  # the nearest to the target
    task.skills[2:4] = 0.7
    for update in range(8, 16):
        bins = step(found, task, update)
    assert (bins == 3).all()
    assert found.log()["allowed_bins"] == 4


def test_uniform_draws_end_where_the_target_is_reached() -> None:
    task = Scripted(torch.tensor([0.9, 0.6, 0.2, 0.1, 0.0]), batch_size=100)
    task.target_shares = torch.tensor([0.0, 0.0, 0.0, 0.75, 0.25])
    found = curriculum(task, delta=0.5, epsilon=5.0, exploration=0.5)
    # None of the target, three quarters of it, and all.
    for skills, uniform in ([0.1, 0.0], 50), ([0.5, 0.0], 12.5), ([0.7, 0.5], 0):
        task.skills[3:] = torch.tensor(skills)
        counts = step(found, task, 0).bincount(minlength=5)
        below = counts[task.skills < 0.5].tolist()
        assert below == [pytest.approx(uniform / 5, abs=1)] * len(below)
    assert counts.tolist() == [0, 0, 0, 75, 25]


def test_the_mazes_target_is_rounded_to_bins() -> None:
    pairs = [(0.2, 4), (0.05, 2), (0.0, 3), (0.9, 2)]
    task = tiny_task(
        distributions={"id": DistributionSettings(specifications=pairs[:3])},
        space=SpaceSettings(obstacle_fractions=[0.0, 0.2], path_lengths=[2, 4, 6]),
    )
    # Lengths have a step of 1, fractions one of 2: length 3 is halfway, and rounded down.
    assert task.target_shares.tolist() == pytest.approx([2 / 3, 0, 0, 0, 1 / 3, 0])
    assert task.space.nearest(pairs).tolist() == [4, 0, 0, 3]
    single = SpecificationSpace((0.1,), (2, 4), height=5, width=5)
    assert single.nearest([(0.0, 4), (0.4, 2)]).tolist() == [1, 0]


def test_a_task_that_does_not_know_where_its_target_is_is_refused() -> None:
    parts = Components(SimpleNamespace(space=None), ProposerSettings(), 0)
    asked = {"curriculum": {"_target_": "proposer_rl.curricula.TransportCurriculum"}}
    with pytest.raises(ValueError, match="needs target_shares of a task, which SimpleNamespace"):
        build(asked, parts)


@pytest.mark.parametrize("seed", [46, 105, 164])
def test_the_nearest_distribution_is_found_where_the_solver_needs_slack(seed: int) -> None:
    """On a plane of bins few of which are allowed; without slack HiGHS ends in an unknown state."""
    plane = ParameterSpace({"a": intervals(0, 1, 8), "b": intervals(0, 1, 5)})
    places = plane.coordinates.double()
    costs = torch.cdist(places, places).square().numpy()
    draw, size = np.random.default_rng(seed), len(places)
    allowed = np.zeros(size, bool)
    allowed[draw.permutation(size)[: draw.integers(1, size)]] = True
    even, target = np.full(size, 1 / size), np.eye(size)[30]
    p, left = step_towards(target, even, costs, allowed, 0.3)
    assert p.sum() == pytest.approx(1) and (p[~allowed] == 0).all()
    # No worse than if all mass goes to its nearest allowed bin, of several to the target's nearest.
    nearest = np.where(allowed, costs, np.inf)
    tied = nearest == nearest.min(1, keepdims=True)
    assert left <= (even * np.where(tied, costs[30], np.inf).min(1)).sum() + 1e-6
