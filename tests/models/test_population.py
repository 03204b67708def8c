"""K copies together are K networks apart."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from proposer_rl.models import Population, UNet
from proposer_rl.models.population import _apply_batched, _apply_in_turn


def small_unet() -> UNet:
    return UNet(channels=(8, 16, 16), groups=4)


def apart(copies: int) -> list[UNet]:
    torch.manual_seed(7)
    return [small_unet() for _ in range(copies)]


def together(copies: int, precision: str = "fp32") -> Population:
    torch.manual_seed(7)
    return Population(small_unet, copies, precision)


def test_outputs_and_gradients_equal_those_of_networks_apart() -> None:
    networks, population = apart(3), together(3)
    planes = torch.rand(3, 5, 3, 10, 10)
    weights = torch.tensor([1.0, -2.0, 0.5])  # each copy has another loss
    policy, value = population(planes)
    ((policy.square().mean((1, 2, 3, 4)) + value.mean((1, 2, 3, 4))) * weights).sum().backward()
    for k, network in enumerate(networks):
        own_policy, own_value = network(planes[k])
        torch.testing.assert_close(policy[k], own_policy)
        torch.testing.assert_close(value[k], own_value)
        ((own_policy.square().mean() + own_value.mean()) * weights[k]).backward()
        for stacked, parameter in zip(population.stacked, network.parameters(), strict=True):
            assert stacked.grad is not None
            torch.testing.assert_close(stacked.grad[k], parameter.grad, rtol=1e-4, atol=1e-6)


def test_the_batched_way_equals_the_way_in_turn() -> None:
    population = together(3)
    planes = torch.rand(3, 4, 3, 7, 9)
    arguments = (population._template[0], population.names, list(population.stacked), (planes,))
    results = {}
    for apply in (_apply_in_turn, _apply_batched):
        outputs = apply(*arguments)
        loss = sum(output.square().sum() for output in outputs)
        results[apply] = (*outputs, *torch.autograd.grad(loss, list(population.stacked)))
    for one, other in zip(*results.values(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def test_one_copy_does_not_see_another() -> None:
    population = together(2)
    planes = torch.rand(2, 3, 3, 6, 6)
    before, _ = population(planes)
    changed = planes.clone()
    changed[1] += 1
    after, _ = population(changed)
    assert torch.equal(before[0], after[0])
    assert not torch.equal(before[1], after[1])


def test_bf16_returns_float32_near_the_fp32_values() -> None:
    planes = torch.rand(2, 3, 3, 10, 10)
    exact, _ = together(2)(planes)
    rounded, _ = together(2, "bf16")(planes)
    assert rounded.dtype == torch.float32
    assert not torch.equal(rounded, exact)
    torch.testing.assert_close(rounded, exact, rtol=0.1, atol=0.1)


def test_a_network_with_one_output_gives_one_output() -> None:
    assert Population(lambda: nn.Linear(4, 2), 3)(torch.rand(3, 5, 4)).shape == (3, 5, 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((small_unet, 0), "copies must be at least 1, got 0"),
        ((small_unet, 1, "fp8"), "precision must be 'fp32' or 'bf16', got 'fp8'"),
        ((lambda: nn.BatchNorm1d(3), 1), "must not have buffers"),
    ],
)
def test_refuses(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Population(*arguments)
