"""The Solver's U-Net: its settings' network, and which mazes it can see."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from proposer_rl.models import UNet
from proposer_rl.tasks.mazes.settings import MazeSettings, NetworkSettings

ACTIONS = 4
PLANES = 3


def unet(settings: NetworkSettings, planes: int) -> UNet:
    """The network of one Solver, which sees so many planes."""
    return UNet(
        in_channels=planes,
        head_channels=(ACTIONS, 1),
        channels=settings.channels,
        groups=settings.groups,
        head_gains=(settings.policy_gain, settings.value_gain),
    )


def faster_precision(channels: Sequence[int], device: torch.device) -> str:
    """``"bf16"`` where it was measured to be faster and to learn alike, else ``"fp32"``.

    That is a wide network on a CPU with instructions for it; see docs/explanation/performance.md.

    Args:
        channels: of the Solver's network.
        device: that it runs on.
    """
    in_hardware = device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()
    return "bf16" if in_hardware and channels[0] >= 64 else "fp32"


def check_network(maze: MazeSettings, network: NetworkSettings) -> None:
    """Refuse a grid that the U-Net of the settings cannot see."""
    size, channels = f"{maze.height}x{maze.width}", network.channels
    if min(maze.height, maze.width) >> (len(channels) - 1) < 1:
        raise ValueError(
            f"network.channels={channels} halve a {size} maze to nothing; give fewer channels or a "
            "larger maze"
        )
    if any(width % network.groups for width in channels):
        raise ValueError(
            f"network.channels={channels} must be multiples of network.groups={network.groups}"
        )
    if _normalises_single_numbers(maze.height, maze.width, network):
        raise ValueError(
            f"network.channels={channels} leave a group of channels with a single number on a "
            f"{size} maze: give more channels, a larger maze or fewer than "
            f"network.groups={network.groups}"
        )


def check_level_size(name: str, size: Sequence[int], network: NetworkSettings) -> None:
    """Refuse a level of a size that the U-Net of the settings cannot see."""
    least = 2 ** (len(network.channels) - 1)
    height, width = size
    if min(height, width) < least:
        raise ValueError(
            f"level {name!r}: its {height}x{width} cells are halved to nothing by this "
            f"Solver; it sees levels of {least}x{least} cells and more"
        )
    if _normalises_single_numbers(height, width, network):
        raise ValueError(
            f"level {name!r}: of its {height}x{width} cells a single number is left to this "
            "Solver in a group of channels; give a larger one"
        )


def _normalises_single_numbers(height: int, width: int, network: NetworkSettings) -> bool:
    """Whether a group of channels of the U-Net has one number, which normalising makes zero."""
    return any(
        (height >> halvings) * (width >> halvings) * channels == network.groups
        for halvings, channels in enumerate(network.channels)
    )
