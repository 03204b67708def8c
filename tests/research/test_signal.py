"""Variance components against known ones, and the instrument on the ladder of skills."""

from __future__ import annotations

import pytest
import torch

from proposer_rl.streams import Streams
from research.signal import by_validation_size, performance_at, variance_components
from tests.skill_ladder import any_mixture, ladder_env

GROUPS, COPIES = 5, 3


def gains(signal: float, noise: float, generator: torch.Generator) -> torch.Tensor:
    groups = signal * torch.randn(GROUPS, 1, generator=generator)
    return 0.3 + groups + noise * torch.randn(GROUPS, COPIES, generator=generator)


@pytest.mark.slow
@pytest.mark.parametrize(("signal", "noise"), [(0.0, 1.0), (1.0, 1.0), (2.0, 0.5)])
def test_the_interval_covers_the_true_ratio_and_the_estimate_is_unbiased(
    signal: float, noise: float
) -> None:
    generator = torch.Generator().manual_seed(0)
    found = [variance_components(gains(signal, noise, generator)) for _ in range(2000)]
    truth = (signal / noise) ** 2
    covered = sum(one.low <= truth <= one.high for one in found) / len(found)
    # At a ratio of 0 an interval cut at 0 can only be missed from above.
    expected = 0.975 if signal == 0 else 0.95
    assert abs(covered - expected) < 0.02
    if signal:
        uncut = [one.ratio for one in found]
        assert abs(sum(uncut) / len(uncut) - truth) < 0.15 * truth + 0.05
    assert abs(sum(one.noise**2 for one in found) / len(found) - noise**2) < 0.05 * noise**2


def test_by_hand() -> None:
    one = variance_components(torch.tensor([[1.0, 3.0], [5.0, 7.0]]))
    # Within: both groups have variance 2. Between: means 2 and 6 have variance 8, of which 2 / 2
    # is due to chance.
    assert (one.mean, one.noise**2) == (4.0, pytest.approx(2.0))
    assert one.signal**2 == pytest.approx(7.0)


def test_refuses_what_has_no_variance() -> None:
    for shape in ((1, 4), (4, 1)):
        with pytest.raises(ValueError, match="at least 2 proposals and 2 replicas"):
            variance_components(torch.zeros(shape))
    with pytest.raises(ValueError, match="must be 1 to 6, got 7"):
        by_validation_size(torch.zeros(2, 2, 6), [6, 7])


def test_smaller_validation_batches_are_the_first_levels() -> None:
    values = torch.randn(4, 3, 10, generator=torch.Generator().manual_seed(1))
    by_size = by_validation_size(values, [2, 10])
    assert by_size[2] == variance_components(values[..., :2].mean(-1))
    assert by_size[10] == variance_components(values.mean(-1))


def test_copies_of_a_proposal_gain_alike_where_chance_has_no_part() -> None:
    env = ladder_env(any_mixture, copies=6, problems=64, meta_episode_length=4, action_repeat=2)
    actions = torch.randn(2, 3, 3, generator=torch.Generator().manual_seed(0))
    start = env.solvers.snapshot()[0]
    before, after = performance_at([0, 2], env, start, actions, torch.zeros(5), Streams(0))
    assert (before["return"] == 0).all()  # a beginner's
    found = after["return"]
    assert found.shape == (3, 2, 5)
    # The draws are systematic, so that only their rounding differs between copies.
    assert found.mean((1, 2)).std() > 5 * found.std(1).max()
