"""What a model of outcomes knows of levels by where they lie in a space."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from proposer_rl.settings import ArgumentError
from proposer_rl.task.contract import Levels

MANY_BINS = 256  # beyond which a model of outcomes has no coefficient for each of them


def space_features(space: Any, levels: Levels) -> Tensor:
    """Features of levels by where they lie in a space, among the bins or beside them.

    With c the coordinates of a level: 1, c, c squared, and for each bin whether it is the nearest,
    unless there are more than :data:`MANY_BINS`.

    Args:
        space: with ``coordinates`` float [N, D] of its N bins, and ``locate(levels)``, the
            coordinates of levels [*B]: float [*B, D].
        levels: [*B].

    Returns:
        float64 [*B, 1 + 2 D + N] on the CPU.

    Raises:
        ArgumentError: if the space cannot locate levels, or has no axes.
    """
    if not hasattr(space, "locate"):
        raise ArgumentError(
            f"space={type(space).__name__}: must define locate(levels), the coordinates of levels, "
            "from which a model of outcomes tells them apart"
        )
    c = space.locate(levels).double().cpu()
    if not c.shape[-1]:
        raise ArgumentError(
            "space: must have axes, by which a model of outcomes tells levels apart; levels that "
            "are seeds alone have none"
        )
    parts = [torch.ones_like(c[..., :1]), c, c.square()]
    if space.size <= MANY_BINS:
        places = space.coordinates.double()
        nearest = torch.cdist(c.flatten(0, -2), places).argmin(-1).view(c.shape[:-1])
        parts.append(torch.nn.functional.one_hot(nearest, len(places)).double())
    return torch.cat(parts, -1)
