"""What is wrong with a task's settings: one line that names the key."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from proposer_rl.tasks.mazes.settings import DistributionSettings, MazeSettings, NetworkSettings


def named(key: str, make: Any, *arguments: Any) -> Any:
    """Make something, naming the key in whatever is wrong with its value."""
    try:
        return make(*arguments)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from error


def check_names(known: Mapping[str, Any], target: str, measured: Sequence[str]) -> None:
    """Refuse names of distributions that there are not."""
    for key, names in (("target", [target]), ("evaluation.distributions", measured)):
        unknown = [name for name in names if name not in known]
        if unknown:
            raise ValueError(f"{key}: must be among {sorted(known)}, got {unknown[0]!r}")


def check_paths(
    maze: MazeSettings, distributions: Mapping[str, DistributionSettings], measured: Iterable[str]
) -> None:
    """Refuse a step limit within which some distribution's goals are out of reach."""
    for name in sorted(measured):
        longest = max(length for _, length in distributions[name].specifications)
        if longest > maze.max_steps:
            raise ValueError(
                f"maze.max_steps={maze.max_steps} must be at least {longest}, the path length of "
                f"distributions.{name}, which is measured on: nobody could reach the goal"
            )


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


def check_size(name: str, size: Sequence[int], network: NetworkSettings) -> None:
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
