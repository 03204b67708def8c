"""3x3 convolutions, as matrix products where the library's kernels are slow."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.grad import conv2d_input

# Where the product below is faster than the library's kernel, measured on a CPU with AMX.
SMALL_MAP = 25  # pixels at most
MANY_CHANNELS = 64  # at least, in and out


class Conv3x3(nn.Conv2d):
    """A 3x3 convolution with a border of zeros; the resolution stays.

    In bf16 on a CPU the library's weight gradient takes several times as long as its forward pass
    on maps of a few pixels with many channels. There it is computed as one matrix product instead;
    everything else, and every other case, is PyTorch's.

    Attributes:
        as_product: whether all of it is one product with every pixel's neighbourhood. The
            convolutions of stacked networks, which have a kernel for each of them otherwise, are
            products of stacks then.
    """

    as_product = False

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(in_channels, out_channels, 3, padding=1)

    def forward(self, maps: Tensor) -> Tensor:
        """Convolve maps [B, in_channels, H, W] to [B, out_channels, H, W]."""
        assert self.bias is not None
        if self.as_product:
            weight = self.weight.permute(2, 3, 1, 0).flatten(0, 2)  # [9 * in, out]
            pixels = torch.addmm(self.bias, _neighbourhoods(maps), weight)
            pixels = pixels.view(len(maps), *maps.shape[-2:], self.out_channels)
            return pixels.permute(0, 3, 1, 2).clone(memory_format=torch.contiguous_format)
        small = maps.shape[-2] * maps.shape[-1] <= SMALL_MAP
        small &= min(self.in_channels, self.out_channels) >= MANY_CHANNELS
        if small and maps.device.type == "cpu" and torch.is_autocast_enabled("cpu"):
            low = torch.get_autocast_dtype("cpu")
            return _ProductGradient.apply(maps.to(low), self.weight.to(low), self.bias.to(low))
        return super().forward(maps)


class _ProductGradient(torch.autograd.Function):
    """``F.conv2d`` with padding 1, and its weight gradient as one matrix product."""

    generate_vmap_rule = True

    @staticmethod
    def forward(maps: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        return F.conv2d(maps, weight, bias, padding=1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:2])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        maps, weight = ctx.saved_tensors
        pixels = gradient.permute(0, 2, 3, 1).flatten(0, 2)  # [B * H * W, out]
        product = pixels.T.contiguous() @ _neighbourhoods(maps)  # [out, 9 * in]
        of_weight = product.unflatten(1, (3, 3, -1)).permute(0, 3, 1, 2)
        wanted = ctx.needs_input_grad[0]
        of_maps = conv2d_input(maps.shape, weight, gradient, padding=1) if wanted else None
        return of_maps, of_weight, pixels.sum(0)


def _neighbourhoods(maps: Tensor) -> Tensor:
    """The 3x3 pixels around every pixel, [B * H * W, 9 * C] from [B, C, H, W]."""
    height, width = maps.shape[-2:]
    padded = F.pad(maps.permute(0, 2, 3, 1), (0, 0, 1, 1, 1, 1))
    around = [padded[:, r : r + height, c : c + width] for r in range(3) for c in range(3)]
    return torch.cat(around, -1).flatten(0, 2)
