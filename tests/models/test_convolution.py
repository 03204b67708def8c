from __future__ import annotations

import pytest
import torch
from torch import nn

from proposer_rl.models.convolution import Conv3x3, _ProductGradient


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (5, 5), (3, 7)])
def test_the_product_gives_the_gradients_of_the_convolution(size: tuple[int, int]) -> None:
    """In float64, so that only the formulas are compared."""
    tensors = [torch.randn(4, 3, *size), torch.randn(6, 3, 3, 3), torch.randn(6)]
    tensors = [tensor.double().requires_grad_() for tensor in tensors]
    slopes = torch.randn(4, 6, *size, dtype=torch.float64)
    results = []
    for convolve in (_ProductGradient.apply, lambda *t: nn.functional.conv2d(*t, padding=1)):
        output = convolve(*tensors)
        results.append((output, *torch.autograd.grad((output * slopes).sum(), tensors)))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize(
    ("channels", "size", "own"), [(64, 2, True), (64, 5, True), (64, 6, False), (32, 2, False)]
)
def test_small_maps_of_many_channels_in_bf16_take_the_product(
    channels: int, size: int, own: bool
) -> None:
    torch.manual_seed(0)
    layer = Conv3x3(channels, 64)
    maps = torch.randn(4, channels, size, size, requires_grad=True)
    with torch.autocast("cpu", torch.bfloat16):
        output = layer(maps)
    assert output.dtype == torch.bfloat16
    assert ("_ProductGradient" in type(output.grad_fn).__name__) == own
    output.float().square().sum().backward()
    plain = nn.functional.conv2d(maps.detach(), layer.weight, layer.bias, padding=1)
    torch.testing.assert_close(output.float(), plain, rtol=0.03, atol=0.03)
    assert layer.weight.grad is not None and maps.grad is not None
    assert layer.weight.grad.dtype == torch.float32


def test_copies_can_take_the_product_all_at_once() -> None:
    tensors = [torch.randn(2, 4, 3, 5, 5), torch.randn(2, 6, 3, 3, 3), torch.randn(2, 6)]
    tensors = [tensor.double().requires_grad_() for tensor in tensors]
    each = torch.stack([_ProductGradient.apply(*(t[k] for t in tensors)) for k in range(2)])
    together = torch.vmap(_ProductGradient.apply)(*tensors)
    torch.testing.assert_close(together, each)
    for one, other in zip(
        torch.autograd.grad(together.square().sum(), tensors),
        torch.autograd.grad(each.square().sum(), tensors),
        strict=True,
    ):
        torch.testing.assert_close(one, other)


def test_in_float32_it_is_pytorchs_own() -> None:
    layer, maps = Conv3x3(8, 16), torch.randn(4, 8, 2, 2)
    expected = nn.functional.conv2d(maps, layer.weight, layer.bias, padding=1)
    assert torch.equal(layer(maps), expected)
