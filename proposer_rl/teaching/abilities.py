"""Students of loops, made of the loop's own functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula.batches import moved

OF_LEVELS = ("optimal_return", "exact_performance", "performance", "play")


def adapted(name: str, function: Any, given: Callable[[Any], Any], device: torch.device) -> Any:
    """Returns a function of levels [n] that calls a loop's own, with levels as the loop gets them.

    Args:
        name: of the function; see :class:`~proposer_rl.curricula.Student`.
        function: of a loop.
        given: makes the loop's levels of levels.
        device: on which it gets them.
    """
    if name not in OF_LEVELS:
        return function

    def of_levels(levels: Any, *more: Any) -> Any:
        draws = more if name == "play" else ()
        found = function(given(moved(levels, device).clone()), *draws)  # which may change them
        if isinstance(found, dict):
            entries = {key: torch.as_tensor(entry).float() for key, entry in found.items()}
            return TensorDict(entries, levels.shape[:1])
        return found if isinstance(found, TensorDictBase) else torch.as_tensor(found)

    return of_levels
