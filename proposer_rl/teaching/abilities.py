"""Students of loops, made of the loop's own functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula.batches import moved

OF_LEVELS = ("optimal_return", "exact_performance", "performance", "play")


def adapted(name: str, function: Any, given: Callable[[Any], Any], device: torch.device) -> Any:
    """Returns a function of levels [1, n] that calls a loop's own function of levels [n].

    Args:
        name: of the function; see :class:`~proposer_rl.curricula.Student`.
        function: of a loop, called with levels as the loop gets them.
        given: makes these of levels.
        device: on which it gets them.
    """
    if name not in OF_LEVELS:
        return function

    def of_one(levels: Any, *more: Any) -> Any:
        some = moved(levels[0] if levels.ndim > 1 else levels, device)
        draws = [more[0][0]] if name == "play" else []
        found = function(given(some.clone()), *draws)  # which may change them
        if isinstance(found, TensorDictBase):
            return found if found.ndim > 2 else found.unsqueeze(0)
        if isinstance(found, dict):
            entries = {key: torch.as_tensor(entry).float() for key, entry in found.items()}
            return TensorDict(entries, some.shape).unsqueeze(0)
        return torch.as_tensor(found).unsqueeze(0)

    return of_one
