"""K copies together are K networks apart."""

from __future__ import annotations

import faulthandler
import os

import pytest
import torch
from torch import nn
from torch.cuda._utils import _get_device_index

from proposer_rl.models import Population, UNet, use_device


def small_unet() -> UNet:
    return UNet(channels=(8, 16, 16), groups=4)


class SharedAndFrozen(nn.Module):
    """Two layers with one weight, the first of which keeps its bias, and one that is not used."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.second, self.last, self.spare = (nn.Linear(3, 3) for _ in range(4))
        self.second.weight = self.first.weight
        self.first.bias.requires_grad_(False)

    def forward(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        hidden = self.second(self.first(inputs).tanh())
        return hidden, self.last(hidden)


def together(copies: int, precision: str = "fp32", make=small_unet, **options) -> Population:
    torch.manual_seed(7)
    return Population(make, copies, precision, **options)


WAYS = [{}, {"cores": 1}, {"cores": 4}, {"batched": True}]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("copies", [1, 3])
@pytest.mark.parametrize(("make", "shape"), [(small_unet, (3, 7, 9)), (SharedAndFrozen, (3,))])
def test_outputs_and_gradients_equal_those_of_networks_apart(make, shape, copies, way) -> None:
    torch.manual_seed(7)
    networks, population = [make() for _ in range(copies)], together(copies, make=make, **way)
    inputs = torch.rand(copies, 5, *shape, requires_grad=True)
    weights = torch.tensor([1.0, -2.0, 0.5])[:copies]  # each copy has another loss
    outputs = population(inputs)
    with torch.no_grad():
        assert all(map(torch.equal, population(inputs), outputs))
    (sum(each.square().flatten(1).mean(1) for each in outputs) * weights).sum().backward()
    for k, network in enumerate(networks):
        alone = inputs[k].detach().requires_grad_()
        own = network(alone)
        for output, other in zip(outputs, own, strict=True):
            torch.testing.assert_close(output[k], other)
        (sum(each.square().mean() for each in own) * weights[k]).backward()
        torch.testing.assert_close(inputs.grad[k], alone.grad, rtol=1e-4, atol=1e-6)
        for stacked, parameter in zip(population.stacked, network.parameters(), strict=True):
            assert stacked.requires_grad == parameter.requires_grad
            if parameter.grad is not None:
                torch.testing.assert_close(stacked.grad[k], parameter.grad, rtol=1e-4, atol=1e-6)
            else:
                assert stacked.grad is None or not stacked.grad.any()


@pytest.mark.parametrize("way", WAYS)
def test_gradients_can_be_taken_one_after_another(way: dict) -> None:
    population, planes = together(3, **way), torch.rand(3, 4, 3, 6, 6)
    policy, value = population(planes)
    policy.sum().backward(retain_graph=True)
    value.sum().backward()
    apart = [parameter.grad for parameter in population.stacked]
    population.zero_grad()
    policy, value = population(planes)
    (policy.sum() + value.sum()).backward()
    for parameter, gradient in zip(population.stacked, apart, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-4)


def test_the_number_of_cores_changes_no_bit() -> None:
    def trained(cores: int) -> list[torch.Tensor]:
        population, planes = together(5, cores=cores), torch.rand(5, 4, 3, 6, 6)
        adam = torch.optim.Adam(population.parameters())
        for _ in range(5):
            adam.zero_grad()
            policy, value = population(planes)
            (policy.square().mean() + value.square().mean()).backward()
            adam.step()
        return [parameter.detach() for parameter in population.parameters()]

    results = []
    for cores in (1, 2, 5):
        torch.manual_seed(1)
        results.append(trained(cores))
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other, strict=True))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")
def test_a_forked_process_has_threads_of_its_own() -> None:
    population = together(2, cores=2)
    population(torch.rand(2, 1, 3, 8, 8))
    child = os.fork()
    if child == 0:
        faulthandler.dump_traceback_later(20, exit=True)  # without threads it would wait for ever
        try:
            population(torch.rand(2, 1, 3, 8, 8))
            os._exit(0)
        finally:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert status == 0


def test_bf16_returns_float32_near_the_fp32_values() -> None:
    planes = torch.rand(2, 3, 3, 10, 10)
    exact, _ = together(2)(planes)
    rounded, _ = together(2, "bf16")(planes)
    assert rounded.dtype == torch.float32
    assert not torch.equal(rounded, exact)
    torch.testing.assert_close(rounded, exact, rtol=0.1, atol=0.1)


def test_buffers_which_replicas_would_share_are_refused() -> None:
    with pytest.raises(ValueError, match="must not have buffers"):
        Population(lambda: nn.BatchNorm1d(3), 1)


@pytest.mark.parametrize(("name", "current"), [("cuda:1", [1]), ("cuda", []), ("cpu", [])])
def test_a_gpu_without_a_number_is_the_current_one(
    name: str, current: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    # What torch.cuda.set_device does first, without a GPU.
    monkeypatch.setattr(torch.cuda, "set_device", lambda d: made.append(_get_device_index(d)))
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda _: None)
    use_device(torch.device(name))
    assert made == current
