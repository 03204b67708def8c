"""A small U-Net: an image of planes in, one map per output out, at the same resolution."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from proposer_rl.models.convolution import Conv3x3

LARGEST_MATRIX = 2**22  # numbers in the weights of an interpolation: a 64x64 grid from its half


class DoubleConv(nn.Sequential):
    """Twice: 3x3 convolution, GroupNorm, ReLU."""

    def __init__(self, in_channels: int, out_channels: int, groups: int) -> None:
        super().__init__(
            Conv3x3(in_channels, out_channels),
            nn.GroupNorm(groups, out_channels),
            nn.ReLU(inplace=True),
            Conv3x3(out_channels, out_channels),
            nn.GroupNorm(groups, out_channels),
            nn.ReLU(inplace=True),
        )


class UNet(nn.Module):
    """Fully convolutional encoder-decoder with skip connections and 1x1 output heads.

    Max-pooling on the way down, bilinear interpolation to the skip's size on the way up (so that
    any height and width works), a 1x1 head per group of output maps (Ronneberger et al. 2015; the
    depth, the channels and the heads are those of the paper's Solver).

    Args:
        in_channels: planes of the input.
        head_channels: maps of each head, e.g. ``(4, 1)`` for action logits and a value.
        channels: channels of each level, from full resolution to the coarsest.
        groups: groups of every GroupNorm; divides each of ``channels``.
        head_gains: gain of each head's orthogonal initialisation.

    Raises:
        ValueError: if a channel count is not a multiple of ``groups``.

    Example:
        >>> network = UNet(channels=(8, 16))
        >>> logits, value = network(torch.zeros(2, 3, 9, 13))
        >>> logits.shape, value.shape
        (torch.Size([2, 4, 9, 13]), torch.Size([2, 1, 9, 13]))
    """

    def __init__(
        self,
        in_channels: int = 3,
        head_channels: Sequence[int] = (4, 1),
        channels: Sequence[int] = (64, 128, 256),
        groups: int = 8,
        head_gains: Sequence[float] = (1.0, 1.0),
    ) -> None:
        super().__init__()
        if any(width % groups for width in channels):
            raise ValueError(f"channels must be multiples of groups={groups}, got {list(channels)}")
        inputs = [in_channels, *channels[:-1]]
        self.down = nn.ModuleList(
            DoubleConv(i, o, groups) for i, o in zip(inputs, channels, strict=True)
        )
        self.up = nn.ModuleList(
            DoubleConv(deep + skip, skip, groups)
            for deep, skip in zip(channels[:0:-1], channels[-2::-1], strict=True)
        )
        self.heads = nn.ModuleList(nn.Conv2d(channels[0], maps, 1) for maps in head_channels)
        orthogonal_(self)
        for head, gain in zip(self.heads, head_gains, strict=True):
            orthogonal_(head, gain)

    def forward(self, planes: Tensor) -> tuple[Tensor, ...]:
        """Map ``planes`` [*B, in_channels, H, W] to one tensor [*B, maps, H, W] for each head."""
        leading = planes.shape[:-3]
        x = planes.reshape(-1, *planes.shape[-3:])
        # Channels last, by permutation: the memory format itself is not available under vmap.
        x = x.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
        skips = []
        for i, block in enumerate(self.down):
            x = block(F.max_pool2d(x, 2) if i else x)
            skips.append(x)
        skips.pop()
        for block in self.up:
            skip = skips.pop()
            x = block(torch.cat([skip, upsample(x, skip.shape[-2:])], 1))
        maps = (head(x) for head in self.heads)
        return tuple(m.reshape(*leading, *m.shape[1:]) for m in maps)


def upsample(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Interpolate maps [B, C, h, w] bilinearly to [B, C, H, W], as ``F.interpolate`` does.

    One product with a constant matrix: on small maps its backward pass takes a fraction of the time
    of the kernel's, and the result stays in the channels-last layout. Maps for which the matrix
    would be large are left to the kernel.
    """
    height, width = size
    if height * width * maps.shape[-2:].numel() > LARGEST_MATRIX:
        return F.interpolate(maps, (height, width), mode="bilinear")
    pixels = maps.permute(0, 2, 3, 1).flatten(1, 2)  # [B, h * w, C]
    weights = _interpolation(*maps.shape[-2:], height, width, maps.device).to(maps.dtype)
    return (weights @ pixels).unflatten(1, (height, width)).permute(0, 3, 1, 2)


@lru_cache(maxsize=64)
def _interpolation(
    height: int, width: int, to_height: int, to_width: int, device: torch.device
) -> Tensor:
    """Weights of every input pixel in every output pixel, float32 [H * W, h * w]."""
    with torch.inference_mode(False), torch.autocast(device.type, enabled=False):
        pixels = torch.eye(height * width, device=device).unflatten(1, (1, height, width))
        columns = F.interpolate(pixels, (to_height, to_width), mode="bilinear")
        return columns.flatten(1).T.contiguous()


def orthogonal_(module: nn.Module, gain: float = 2**0.5) -> None:
    """Initialise every convolution and linear layer orthogonally, biases with zero (in place).

    The default gain keeps the variance of activations through ReLU layers (Saxe et al. 2014).
    """
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.orthogonal_(layer.weight, gain)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
