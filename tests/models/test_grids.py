from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from proposer_rl.models import UNet
from proposer_rl.models.grids import upsample
from proposer_rl.models.population import Conv3x3, _ProductGradient


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (5, 5), (3, 7)])
def test_the_product_gives_the_gradients_of_the_convolution(size: tuple[int, int]) -> None:
    """In float64, so that only the formulas are compared."""
    tensors = [torch.randn(4, 3, *size), torch.randn(6, 3, 3, 3), torch.randn(6)]
    tensors = [tensor.double().requires_grad_() for tensor in tensors]
    slopes = torch.randn(4, 6, *size, dtype=torch.float64)
    results = []
    for convolve in (_ProductGradient.apply, lambda *t: F.conv2d(*t, padding=1)):
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
    plain = F.conv2d(maps.detach(), layer.weight, layer.bias, padding=1)
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


@pytest.mark.parametrize(("height", "width"), [(10, 10), (4, 4), (13, 7), (21, 21), (99, 80)])
def test_maps_have_the_resolution_of_the_input(height: int, width: int) -> None:
    policy, value = UNet(channels=(8, 16, 16), groups=4)(torch.rand(2, 3, height, width))
    assert policy.shape == (2, 4, height, width)
    assert value.shape == (2, 1, height, width)


def test_parameters_of_the_papers_network() -> None:
    def double(fan_in: int, out: int) -> int:
        return 9 * fan_in * out + 9 * out * out + 2 * out + 4 * out  # weights, biases, norms

    expected = (
        double(3, 64) + double(64, 128) + double(128, 256)
        + double(256 + 128, 128) + double(128 + 64, 64)
        + 64 * 5 + 5
    )  # fmt: skip
    assert sum(p.numel() for p in UNet().parameters()) == expected == 1_885_957


def test_every_layer_is_orthogonal() -> None:
    network = UNet(channels=(8, 16, 16), groups=4, head_gains=(0.01, 1.0))
    gains = {id(network.heads[0]): 0.01, id(network.heads[1]): 1.0}
    layers = [m for m in network.modules() if isinstance(m, nn.Conv2d)]
    assert len(layers) == 12
    for layer in layers:
        weight = layer.weight.detach().flatten(1)
        if weight.shape[0] > weight.shape[1]:
            weight = weight.T
        square = gains.get(id(layer), 2**0.5) ** 2 * torch.eye(len(weight))
        torch.testing.assert_close(weight @ weight.T, square, rtol=1e-4, atol=1e-5)
        assert layer.bias is not None and not layer.bias.any()


def test_large_grids_need_no_large_matrix() -> None:
    maps = torch.rand(1, 2, 300, 300)  # the matrix would have 32 billion numbers
    expected = F.interpolate(maps, (601, 600), mode="bilinear")
    torch.testing.assert_close(upsample(maps, (601, 600)), expected)


@pytest.mark.parametrize("small", [(1, 1), (2, 2), (5, 5), (3, 6)])
@pytest.mark.parametrize("large", [(4, 5), (10, 10), (7, 13)])
def test_upsampling_is_bilinear_interpolation(
    small: tuple[int, int], large: tuple[int, int]
) -> None:
    maps = torch.rand(2, 3, *small, requires_grad=True)
    weights = torch.rand(2, 3, *large)
    results = []
    for result in (upsample(maps, large), F.interpolate(maps, large, mode="bilinear")):
        (gradient,) = torch.autograd.grad((result * weights).sum(), maps)
        results.append((result, gradient))
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other)
