"""Adam for copies: torch's numbers, and the same ones in whatever place a copy stands."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from proposer_rl.learning.adam import LANES, CopiesAdam

SHAPES = [(4,), (1,), (LANES,), (5, 3), (2, LANES), (7, LANES + 1)]


def gradients(copies: int, steps: int) -> list[list[Tensor]]:
    generator = torch.Generator().manual_seed(0)
    return [
        [torch.randn(copies, *shape, generator=generator) for shape in SHAPES] for _ in range(steps)
    ]


def moved(slopes: list[list[Tensor]], copies: int | None) -> list[Tensor]:
    """Parameters that begin at one, after a step along each of the slopes."""
    parameters = [nn.Parameter(torch.ones_like(slope)) for slope in slopes[0]]
    adam = CopiesAdam(parameters, copies, 0.1, 1e-5)
    for step in slopes:
        adam.zero_grad()
        for parameter, slope in zip(parameters, step, strict=True):
            parameter.grad = slope.clone()
        adam.step()
    states = [adam.state(i) for i in range(len(parameters))]
    assert all(state["step"] == len(slopes) for state in states)
    assert all(
        state["exp_avg"].shape == state["exp_avg_sq"].shape == parameter.shape
        for state, parameter in zip(states, parameters, strict=True)
    )
    return [p.detach() for p in parameters]


@pytest.mark.parametrize("copies", [3, None])
def test_moves_as_torchs_adam(copies: int | None) -> None:
    slopes = gradients(3, 5)
    plain = [nn.Parameter(torch.ones_like(slope)) for slope in slopes[0]]
    adam = torch.optim.Adam(plain, lr=0.1, eps=1e-5)
    for step in slopes:
        for parameter, slope in zip(plain, step, strict=True):
            parameter.grad = slope
        adam.step()
    for ours, theirs in zip(moved(slopes, copies), plain, strict=True):
        torch.testing.assert_close(ours, theirs.detach())


@settings(max_examples=30, deadline=None)
@given(chosen=st.lists(st.integers(0, 3), min_size=1, max_size=6))
def test_a_copy_moves_alike_in_whatever_place_it_stands(chosen: list[int]) -> None:
    slopes = gradients(4, 5)
    there = [[slope[chosen] for slope in step] for step in slopes]
    for ours, all_four in zip(moved(there, len(chosen)), moved(slopes, 4), strict=True):
        assert torch.equal(ours, all_four[chosen])


def test_a_parameter_without_gradient_stays() -> None:
    used, unused = (nn.Parameter(torch.ones(2, 3)) for _ in range(2))
    adam = CopiesAdam([used, unused], 2, 0.1, 1e-5)
    for slope in (torch.ones(2, 3), None):
        adam.zero_grad()
        used.grad = slope
        before = used.detach().clone()
        adam.step()
        assert torch.equal(used, before) == (slope is None)
        assert (unused == 1).all()
