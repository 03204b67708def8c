"""What a loop's own functions can do for a curriculum, and a plain actor and critic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.settings import ArgumentError

OF_LEVELS = ("values", "optimal_return", "exact_performance", "performance", "play")


def adapted(name: str, function: Any, given: Callable[[Any], Any]) -> Any:
    """A function of levels [n] as one of levels [1, n], with the argument checked.

    Args:
        name: of the function; see :class:`~proposer_rl.curricula.Student`.
        function: of a loop, with levels as that gets them.
        given: from levels to these.
    """
    if name not in OF_LEVELS:
        return function
    if not callable(function):
        raise ArgumentError(f"{name}={function!r:.60}: must be a function of levels")

    def of_one(levels: Any, *more: Any) -> Any:
        some = levels[0] if levels.ndim > 1 else levels
        draws = [more[0][0]] if name == "play" else []
        found = function(given(some), *draws)
        if isinstance(found, TensorDictBase):
            return found if found.ndim > 2 else found.unsqueeze(0)
        if isinstance(found, dict):
            entries = {key: torch.as_tensor(entry).float() for key, entry in found.items()}
            return TensorDict(entries, some.shape).unsqueeze(0)
        return torch.as_tensor(found).unsqueeze(0)

    return of_one
