"""The belief against scikit-learn, a weighted regression, exact posteriors, a moving learner."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from proposer_rl.curricula.belief import Belief


def draws(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1


@pytest.mark.parametrize("inputs", [1, 3, 30])
def test_a_first_batch_is_scikit_learns_regression(inputs: int) -> None:
    """The maximum of the posterior is that of a penalised regression on the same columns."""
    linear = pytest.importorskip("sklearn.linear_model")
    x = draws(60, inputs)
    labels = (draws(60, seed=1) < x[..., 0]).double()
    belief = Belief(inputs, ridge=0.3)
    belief.observe(x, labels)
    fit = linear.LogisticRegression(C=1 / 0.3, fit_intercept=False, tol=1e-10, max_iter=5000)
    fit.fit(belief._columns(x).numpy(), labels.numpy())
    assert belief._mean.numpy() == pytest.approx(fit.coef_[0], abs=2e-3)


def test_older_batches_count_as_a_regression_with_their_ages_weighs_them() -> None:
    belief = Belief(2, half_life=4.0, ridge=1e-9)
    batches = [(draws(25, 2, seed=t), draws(25, seed=9 + t).add(1).div(2)) for t in range(3)]
    expected = torch.zeros_like(belief._precision)
    for age, (x, labels) in zip((2, 1, 0), batches, strict=True):
        belief.grow_older()
        belief.observe(x, labels)
        phi = belief._columns(x)
        p = (phi @ belief._mean).sigmoid()
        phi[..., 1] = -age / 4.0
        weight = 2.0 ** (-age / 4.0) * (p * (1 - p)).clamp(min=1e-3)
        expected += phi.mT @ (weight.unsqueeze(-1) * phi)
    assert torch.allclose(belief._precision, expected, atol=1e-6)


def test_an_item_has_the_posterior_of_its_own_successes() -> None:
    """Of many levels that look alike, those that were seen are told apart: on a grid of u."""
    x = torch.zeros(8, 1, dtype=torch.float64)
    items = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1])
    labels = torch.tensor([1.0, 1, 1, 1, 0, 0, 0, 1], dtype=torch.float64)
    belief = Belief(1, items=3)
    belief.observe(x, labels, items)
    z = float(belief._columns(x)[0] @ belief._mean)
    u = np.linspace(-6, 6, 4001)
    for item, (won, lost) in enumerate([(4, 0), (1, 3), (0, 0)]):
        p = 1 / (1 + np.exp(-(z + u)))
        density = np.exp(-(u**2) / 2) * p**won * (1 - p) ** lost
        mode = u[density.argmax()]
        assert float(belief._own[item]) == pytest.approx(mode, abs=0.01)
    p = belief.predict(x[:3], torch.tensor([0, 1, 2]))
    assert p[0] > p[2] > p[1]


def test_without_data_nothing_is_known() -> None:
    belief = Belief(3, items=5)
    p = belief.predict(draws(5, 3), torch.arange(5))
    assert torch.allclose(p, torch.full_like(p, 0.5))


def test_what_is_not_seen_any_more_is_forgotten() -> None:
    belief = Belief(1, items=2, half_life=2.0)
    x, items = torch.zeros(30, 1).double(), torch.zeros(30).long()
    belief.observe(x, torch.ones(30).double(), items)
    sure = float(belief.predict(x[:1], items[:1]))
    for _ in range(300):
        belief.grow_older()
    assert sure > 0.85
    assert float(belief.predict(x[:1], items[:1])) == pytest.approx(0.5, abs=0.02)


def test_predictions_of_a_learner_that_moves_are_calibrated() -> None:
    """Its frontier moves through a square; predictions of the next batch against rates of bins."""
    generator = torch.Generator().manual_seed(3)
    belief = Belief(2)
    predicted, happened, truth = [], [], []
    for t in range(80):
        x = 2 * torch.rand(64, 2, generator=generator, dtype=torch.float64) - 1
        odds = 6 * (t / 40 - 1 - x[..., 0]) - 3 * x[..., 1].square()
        won = (torch.rand(64, generator=generator) < odds.sigmoid()).double()
        if t >= 10:
            predicted.append(belief.predict(x)), happened.append(won), truth.append(odds.sigmoid())
        belief.grow_older()
        belief.observe(x, won)
    p, y, q = (torch.cat(one) for one in (predicted, happened, truth))
    best, constant = (q * (1 - q)).mean(), y.var()
    brier = (p - y).square().mean()
    assert brier < best + 0.15 * (constant - best)
    for low in torch.linspace(0.05, 0.85, 5):
        inside = (p >= low) & (p < low + 0.2)
        error = (p[inside].mean() - y[inside].mean()).abs()
        assert error < 0.05 + 3 * math.sqrt(0.25 / int(inside.sum()))


def test_a_state_goes_on_as_if_nothing_had_happened() -> None:
    x, labels, items = draws(20, 2), draws(20, seed=1).gt(0).double(), torch.arange(20)
    one = Belief(2, items=20)
    one.observe(x, labels, items)
    other = Belief(2, items=20)
    other.load_state_dict(one.state_dict())
    for belief in (one, other):
        belief.grow_older()
        belief.observe(x.flip(0), labels, items.flip(0))
    assert torch.equal(one.predict(x), other.predict(x))
