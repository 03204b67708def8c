"""The settings of the maze task, the U-Net that they make, and which mazes it can see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Interval, Len

from proposer_rl.models import UNet
from proposer_rl.settings import settings

Mechanism = Literal["uniform", "path_first"]
Fraction = Annotated[float, Interval(ge=0, lt=1)]
PathLength = Annotated[int, Ge(1)]
Fractions = Fraction | Annotated[list[Fraction], Len(1)]
PathLengths = PathLength | Annotated[list[PathLength], Len(1)]
Channels = Annotated[list[Annotated[int, Ge(1)]], Len(1)]


@settings
class MazeSettings:
    """The inner environment.

    Attributes:
        height, width: the grid, in cells.
        max_steps: steps after which an episode is truncated.
        step_penalty: what every step costs.
        observe_agent: draw the agent on a fourth plane; then every step needs its own forward pass.
    """

    height: Annotated[int, Interval(ge=1, le=1000)] = 10
    width: Annotated[int, Interval(ge=1, le=1000)] = 10
    max_steps: Annotated[int, Ge(1)] = 25
    step_penalty: Annotated[float, Ge(0)] = 0.01
    observe_agent: bool = False


@settings
class DistributionSettings:
    """Levels drawn uniformly from (obstacle fraction, path length) pairs, by one mechanism."""

    specifications: Annotated[list[tuple[Fraction, PathLength]], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class SpaceSettings:
    """The Proposer's bins: every obstacle fraction with every path length."""

    obstacle_fractions: Annotated[list[Fraction], Len(1)]
    path_lengths: Annotated[list[PathLength], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class UNetSettings:
    """The Solver's U-Net.

    Attributes:
        channels: of each resolution, finest first.
        groups: of every GroupNorm; divides each of the channels.
        policy_gain, value_gain: gains of the heads' orthogonal initialisation.
    """

    channels: Channels
    groups: Annotated[int, Ge(1)] = 8
    policy_gain: Annotated[float, Ge(0)] = 0.01
    value_gain: Annotated[float, Ge(0)] = 1.0


@settings
class MazeEvaluationSettings:
    """Settings of how the Solver is measured, apart from its training.

    Attributes:
        distributions: names of the distributions that are measured on.
        levels: number of levels of each distribution, the same in every run.
        seed: from which they are drawn.
        evaluator: of the Proposer's validation levels: exact, or Monte-Carlo episodes.
        episodes: Monte-Carlo episodes per level.
    """

    distributions: Annotated[list[str], Len(1)]
    levels: Annotated[int, Ge(1)] = 512
    seed: Annotated[int, Ge(0)] = 0
    evaluator: Literal["exact", "rollout"] = "exact"
    episodes: Annotated[int, Ge(1)] = 1


ACTIONS = 4
PLANES = 3


def unet(settings: UNetSettings, planes: int) -> UNet:
    """Returns the U-Net of one Solver, which sees so many planes."""
    return UNet(
        in_channels=planes,
        head_channels=(ACTIONS, 1),
        channels=settings.channels,
        groups=settings.groups,
        head_gains=(settings.policy_gain, settings.value_gain),
    )


def faster_precision(channels: Sequence[int], device: torch.device) -> str:
    """Returns ``"bf16"`` where it was measured to be faster and to learn alike, else ``"fp32"``.

    That is a wide network on a CPU with instructions for it; see docs/explanation/performance.md.

    Args:
        channels: of the Solver's network.
        device: that it runs on.
    """
    in_hardware = device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()
    return "bf16" if in_hardware and channels[0] >= 64 else "fp32"


def check_grid(what: str, size: Sequence[int], network: UNetSettings) -> None:
    """Refuses a grid that the U-Net of the settings halves to nothing, or to single numbers.

    Of those GroupNorm makes zeros.
    """
    height, width = size
    if any(
        (height >> halvings) * (width >> halvings) * channels <= network.groups
        for halvings, channels in enumerate(network.channels)
    ):
        raise ValueError(
            f"{what}: {height}x{width} cells are too few for this Solver: with "
            f"network.channels={network.channels} and network.groups={network.groups} a group of "
            "channels is left with one number or none"
        )
