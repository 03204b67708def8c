"""The bins and the target of an environment's parameter, as its settings give them."""

from __future__ import annotations

import torch

from proposer_rl.tasks.gymnasium.settings import ParameterSettings
from proposer_rl.tasks.parameters import Bins, intervals, points


def space_bins(settings: ParameterSettings) -> Bins:
    """The bins of a parameter.

    Raises:
        ValueError: if it has neither values nor a range, both, or they do not rise.
    """
    range_ = (settings.low, settings.high, settings.bins)
    if settings.values is not None:
        if any(number is not None for number in range_):
            raise ValueError("either values, or low, high and bins")
        return points(settings.values)
    low, high, bins = range_
    if low is None or high is None or bins is None:
        raise ValueError("needs values, or low, high and bins")
    return intervals(low, high, bins)


def target_bins(settings: ParameterSettings) -> Bins:
    """What of a parameter the Solver is to master.

    Raises:
        ValueError: if it is no part of a line.
    """
    target = settings.target if isinstance(settings.target, list) else [settings.target]
    kind = space_bins(settings).low.dtype
    if settings.values is not None or len(target) == 1:
        single = points(target, "target")
        if kind == torch.int64 and single.low.dtype != kind:
            raise ValueError(f"target={target} must be whole, as values={settings.values} are")
        return Bins(*(end.to(kind) for end in single))
    if len(target) > 2 or not target[0] < target[1]:
        raise ValueError(f"target={target} must be a number or [from, to]")
    low, high = torch.tensor(target, dtype=kind)
    return Bins(low.view(1), high.view(1))
