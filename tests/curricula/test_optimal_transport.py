"""CurrOT and SPDL: steps towards the target against searches on grids, and scripted students."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import kstest, truncnorm

import proposer_rl as prl
from proposer_rl.curricula import SelfPacedCurriculum
from proposer_rl.curricula import self_paced as spdl
from proposer_rl.curricula.optimal_transport import TransportCurriculum, step_towards
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import Components, build
from proposer_rl.tasks.mazes import SpecificationSpace
from proposer_rl.tasks.mazes.task import DistributionSettings, SpaceSettings
from proposer_rl.tasks.parameters import ParameterSpace, intervals, points
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


NOW, TARGET = (spdl.Gaussian(np.array([m]), np.array([s])) for m, s in ((-0.2, 0.3), (0.8, 0.02)))
EPSILON, LEAST = 0.1, 0.01


def episodes(seed: int, middle: float) -> tuple[spdl.Floats, spdl.Floats, spdl.Floats]:
    """Those of a student that succeeds below a place, drawn from the present Gaussian."""
    noise = np.random.default_rng(seed)
    places = truncnorm.rvs(-0.8 / 0.3, 1.2 / 0.3, -0.2, 0.3, size=(60, 1), random_state=noise)
    density = truncnorm.logpdf(places[:, 0], -0.8 / 0.3, 1.2 / 0.3, -0.2, 0.3)
    solved = noise.random(60) < 1 / (1 + np.exp((places[:, 0] - middle) / 0.1))
    return places, density, solved.astype(float)


def on_a_grid(
    seen: tuple[spdl.Floats, spdl.Floats, spdl.Floats], delta: float
) -> tuple[float, float]:
    """Divergence from the target and expected performance of the best of all Gaussians near NOW."""
    means, deviations = np.meshgrid(np.linspace(-1, 1, 801), np.geomspace(LEAST, 2, 400))
    places, density, solved = seen

    def apart(other: spdl.Gaussian) -> spdl.Floats:
        ratio, away = deviations / other.deviation, (means - other.mean) / other.deviation
        found: spdl.Floats = (ratio**2 + away**2 - 1) / 2 - np.log(ratio)
        return found

    near = apart(NOW) <= EPSILON
    means, deviations, left = means[near], deviations[near], apart(TARGET)[near]
    z = (places - means) / deviations
    weight = np.exp(-(z**2) / 2 - density[:, None])
    performance = (weight * solved[:, None]).sum(0) / weight.sum(0)
    enough = performance >= delta
    if not enough.any():
        return float(left[performance.argmax()]), float(performance.max())
    best = np.where(enough, left, np.inf).argmin()
    return float(left[best]), float(performance[best])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("delta", [0.2, 0.6, 0.75, 0.99])
@pytest.mark.parametrize("middle", [0.1, -0.2])
def test_a_step_is_the_best_on_a_grid(seed: int, delta: float, middle: float) -> None:
    seen = episodes(seed, middle)
    left, performance = on_a_grid(seen, delta)
    new, expected = spdl.step_towards(TARGET, NOW, *seen, delta, EPSILON, LEAST)
    assert spdl.divergence(new, NOW)[0] <= EPSILON + 1e-3
    assert expected == pytest.approx(spdl.expected_performance(new, *seen)[0])
    if performance >= delta:
        assert expected >= delta - 1e-3
        assert spdl.divergence(new, TARGET)[0] <= 1.01 * left
    else:
        assert expected >= performance - 2e-3


def test_gradients_are_those_of_differences() -> None:
    noise = np.random.default_rng(0)
    at, other = noise.normal(size=6), spdl.Gaussian(noise.normal(size=3), noise.uniform(0.5, 1, 3))
    seen = noise.normal(size=(9, 3)), noise.normal(size=9), noise.normal(size=9)

    def gaussian(x: spdl.Floats) -> spdl.Gaussian:
        return spdl.Gaussian(x[:3], np.exp(x[3:]))

    for value in (
        lambda x: spdl.divergence(gaussian(x), other),
        lambda x: spdl.expected_performance(gaussian(x), *seen),
    ):
        steps = 1e-6 * np.eye(6)
        slopes = [(value(at + s)[0] - value(at - s)[0]) / 2e-6 for s in steps]
        np.testing.assert_allclose(value(at)[1], slopes, rtol=1e-5, atol=1e-7)


def test_draws_are_those_of_a_gaussian_within_the_box() -> None:
    mean, deviation = torch.tensor([0.9, -1.0]).double(), torch.tensor([0.5, 0.1]).double()
    shares = torch.rand(2000, 2, generator=torch.Generator().manual_seed(0)).double()
    places, density = spdl.draw_in_box(mean, deviation, shares)
    expected = np.zeros(2000)
    for axis in range(2):
        at, wide = float(mean[axis]), float(deviation[axis])
        law = truncnorm((-1 - at) / wide, (1 - at) / wide, at, wide)
        assert kstest(places[:, axis].numpy(), law.cdf).pvalue > 0.01
        expected += law.logpdf(places[:, axis].numpy())
    # But for one factor.
    np.testing.assert_allclose((density.numpy() - expected).std(), 0, atol=1e-9)


def test_a_place_is_where_a_level_comes_from() -> None:
    space = ParameterSpace({"x": intervals(-4, 4, 8), "n": points([1, 2, 7]), "one": points([3])})
    drawn = torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(1)).double() * 2 - 1
    levels = space.at(drawn, [torch.Generator()])
    again = space.at(space.place(levels), [torch.Generator()])
    for name in ("x", "n", "one"):
        torch.testing.assert_close(again[name], levels[name])


def paced(task: Scripted, **options: Any) -> SelfPacedCurriculum:
    target: Any = None  # whose shares are known
    numbers = {"episodes": 24, "epsilon": 0.2, **options}
    return SelfPacedCurriculum(task.space, target, task.target_shares, **numbers)


def test_it_goes_to_the_target_where_the_student_succeeds_and_waits_where_not() -> None:
    told, last = {}, {}
    for solved in (9, 5, 0):
        task = Scripted((torch.arange(9) < solved).float(), batch_size=24)
        curriculum = paced(task, delta=0.6)
        for update in range(40):
            last[solved] = step(curriculum, task, update)
        told[solved] = curriculum.log()
        assert sum(told[solved]["histogram"]) == 40 * 24
    assert (last[9] == 8).all() and told[9]["target_divergence"] < 0.01
    share = float((last[5] < 5).double().mean())
    assert 0.4 < share < 0.95 and told[5]["expected_performance"] > 0.5
    assert told[0]["means"] == [0.0] and told[0]["deviations"] == [0.5]  # nothing to go by


def test_levels_are_as_they_are_and_the_target_is_exact() -> None:
    space = prl.Parameters({"x": (0.0, 10.0)}, target={"x": 9.3})
    curriculum = prl.Teacher(
        prl.curricula.spdl(rounded=False, episodes=30, epsilon=0.5, start={"x": -1.0}), space
    )
    first = curriculum.propose(30)["x"]
    assert first.min() >= 0 and float(first.median()) < 2.5
    for _ in range(30):
        curriculum.observe({"return": [0.0] * 30, "success": [1.0] * 30})
        drawn = curriculum.propose(30)["x"]
    assert float(drawn.mean()) == pytest.approx(9.3, abs=0.05)
    assert float(drawn.std()) == pytest.approx(0.05, abs=0.02)  # of a least deviation of 0.01
