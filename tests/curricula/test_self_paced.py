"""Self-paced learning: its steps against a search on a grid, its draws, scripted students."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import kstest, truncnorm

import proposer_rl as prl
from proposer_rl.curricula import SelfPacedCurriculum
from proposer_rl.curricula import self_paced as spdl
from proposer_rl.tasks.parameters import ParameterSpace, intervals, points
from tests.curricula.scripted import Scripted, step

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
