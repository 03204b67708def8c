"""Adapts functions of a training loop to what curricula call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula.batches import moved

OF_LEVELS = ("optimal_return", "exact_performance", "performance", "play")


def adapted(name: str, function: Any, given: Callable[[Any], Any], device: torch.device) -> Any:
    """Wraps a loop's function of levels [n], so that it gets levels as the loop does.

    Args:
        name: the function's name in :class:`~proposer_rl.curricula.Student`.
        function: the loop's function.
        given: converts levels for the loop.
        device: the device on which the loop gets levels.
    """
    if name not in OF_LEVELS:
        return function

    def of_levels(levels: Any, *more: Any) -> Any:
        draws = more if name == "play" else ()
        found = function(given(moved(levels, device).clone()), *draws)  # it may change the copy
        if isinstance(found, dict):
            entries = {key: torch.as_tensor(entry).float() for key, entry in found.items()}
            return TensorDict(entries, levels.shape[:1])
        return found if isinstance(found, TensorDictBase) else torch.as_tensor(found)

    return of_levels
