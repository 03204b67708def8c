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


def items_seen(seed: int = 0) -> tuple[Tensor, ...]:
    """Returns inputs, successes, items that come up to three times, and counts of answers."""
    generator = torch.Generator().manual_seed(seed)
    items = torch.randint(12, (30,), generator=generator)
    counts = torch.tensor([4.0, 8.0, 2.0], dtype=torch.float64)[items % 3]
    won = (counts * torch.rand(30, generator=generator)).round() / counts
    return draws(12, 2, seed=seed)[items], won, items, counts


def test_items_and_inputs_are_scikit_learns_regression_together() -> None:
    """With a column for each item; precisions are those of the full matrix."""
    linear = pytest.importorskip("sklearn.linear_model")
    x, won, items, counts = items_seen()
    belief = Belief(2, items=12, ridge=0.3)
    belief.observe(x, won, items, counts)
    own = math.sqrt(0.3) * torch.nn.functional.one_hot(items, 12).double()
    columns = torch.cat([belief._columns(x), own], 1).repeat(2, 1).numpy()
    labels = np.repeat([1.0, 0.0], 30)
    weights = torch.cat([counts * won, counts * (1 - won)]).numpy()
    fit = linear.LogisticRegression(C=1 / 0.3, fit_intercept=False, tol=1e-10, max_iter=5000)
    beta = fit.fit(columns, labels, sample_weight=weights).coef_[0]
    size = len(belief._mean)
    assert belief._mean.numpy() == pytest.approx(beta[:size], abs=2e-3)
    assert belief._own.numpy() == pytest.approx(beta[size:] * math.sqrt(0.3), abs=2e-3)
    p = 1 / (1 + np.exp(-columns[:30] @ beta))
    bend = counts.numpy() * p * (1 - p)
    full = 0.3 * np.eye(size + 12) + columns[:30].T @ (bend[:, None] * columns[:30])
    covariance = np.linalg.inv(full)[:size, :size]
    assert np.linalg.inv(belief._precision.numpy()) == pytest.approx(covariance, abs=5e-3)


def test_a_group_weighs_as_much_as_its_answers() -> None:
    x, won, items, counts = items_seen(1)
    groups, answers = Belief(2, items=12), Belief(2, items=12)
    groups.observe(x, won, items, counts)
    row = torch.arange(30).repeat_interleave(counts.long())
    first = torch.cat([torch.arange(int(n)) for n in counts])
    labels = (first < (won * counts)[row] - 1e-6).double()
    answers.observe(x[row], labels, items[row])
    for name in ("_mean", "_precision", "_own", "_seen"):
        torch.testing.assert_close(getattr(groups, name), getattr(answers, name))


def test_draws_are_of_the_posterior() -> None:
    x, won, items, counts = items_seen(2)
    belief = Belief(2, items=12)
    belief.observe(x, won, items, counts)
    x, items = x[:5], items[:5]
    belief.predict(x, items)
    generator = torch.Generator().manual_seed(0)
    z = torch.stack([belief.draw(x, items, generator).logit() for _ in range(1500)])
    phi = belief._columns(x)
    variance = ((phi @ belief._covariance) * phi).sum(-1)
    variance = variance + belief._doubt(items)
    assert torch.allclose(z.mean(0), phi @ belief._mean + belief._own[items], atol=0.1)
    assert torch.allclose(z.var(0), variance, rtol=0.15)


SHIFT = torch.tensor([0.0, 1.0, 2.0, -1.0], dtype=torch.float64)


def brier(prior: str, batches: int = 60) -> dict[str, float]:
    """Returns squared errors of p, from the middle on, of the belief and of Beta posteriors.

    300 items of four sources, whose difficulties differ as much again within each; a learner that
    gets better at each source at a speed of its own.
    """
    draw = torch.Generator().manual_seed(0)
    source, apart = torch.arange(300) % 4, torch.randn(300, generator=draw).double()
    x = torch.nn.functional.one_hot(source, 4).double() - 0.25
    odds = {"none": None, "good": -apart - SHIFT[source] + 1, "bad": 2 * (apart + SHIFT[source])}
    belief = Belief(4, items=300, expected=odds[prior])
    beta = {decay: torch.ones(2, 300).double() for decay in (1.0, 0.9, 0.7, 0.5)}
    errors: dict[str, list[float]] = {}
    for t in range(batches):
        speed = torch.tensor([1.0, 2.0, 3.0, 0.5], dtype=torch.float64)[source]
        p = (2 * speed * t / batches - 1.5 - SHIFT[source] - apart).sigmoid()
        items = torch.randperm(300, generator=draw)[:32]
        right = torch.bernoulli(p[items].expand(8, -1), generator=draw).sum(0)
        guesses = {"belief": belief.predict(x[items], items)}
        guesses |= {f"{d}": ab[0, items] / ab.sum(0)[items] for d, ab in beta.items()}
        for name, guess in guesses.items() if t >= batches // 2 else ():
            errors.setdefault(name, []).append(float((guess - p[items]).square().mean()))
        belief.grow_older()
        belief.observe(x[items], right / 8, items, torch.full_like(right, 8))
        for decay, ab in beta.items():
            both = torch.stack([right, 8 - right])
            ab[:, items] = decay * ab[:, items] + 1 - decay + both
    return {name: sum(found) / len(found) for name, found in errors.items()}


def test_a_learner_that_moves_is_followed_better_than_by_beta_posteriors() -> None:
    """Also with a prior from pass rates: a good one helps, and a bad one is outgrown."""
    found = brier("none")
    ours = found.pop("belief")
    assert ours < 0.5 * min(found.values())
    assert brier("good")["belief"] < ours
    assert brier("bad")["belief"] < min(found.values())


def test_the_variance_among_items_is_learnt() -> None:
    draw = torch.Generator().manual_seed(0)
    for apart in (0.2, 2.0):
        belief = Belief(0, items=200)
        z = apart * torch.randn(200, generator=draw, dtype=torch.float64)
        for _ in range(30):
            right = torch.bernoulli(z.sigmoid().expand(8, -1), generator=draw).mean(0)
            belief.grow_older()
            count = torch.full_like(right, 8)
            belief.observe(torch.zeros(200, 0).double(), right, torch.arange(200), count)
        assert float(belief._apart.sqrt()) == pytest.approx(apart, rel=0.4)


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
