"""Results as loops tell them, and as curricula observe them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.settings import ArgumentError

RESULTS = ("return", "success", "score", "episodes", "steps")
COUNTS = ("episodes", "steps")


def as_outcome(results: Mapping[str, NDArray[np.float64]]) -> TensorDict:
    """Returns what curricula observe, [K, n], of the results [K, n] that were told.

    Where nothing was told, which is NaN, there was one episode of one step; what is missing of
    another result for one level is left out for all.
    """
    outcome = {}
    for name, result in results.items():
        missing = np.isnan(result)
        if name in COUNTS:
            outcome[name] = torch.from_numpy(np.where(missing, 1, result).astype(np.int64))
        elif not missing.any():
            outcome[name] = torch.from_numpy(result.astype(np.float32))
    return TensorDict(outcome, outcome["return"].shape)


def as_array(
    name: str, value: Any, shape: tuple[int, ...], for_all: bool = False
) -> NDArray[np.float64]:
    """Numbers of a shape as an array on the CPU, whatever they are given as.

    Args:
        name: of the argument.
        value: the numbers; of one level without that dimension, too.
        shape: [n] or [K, n].
        for_all: whether one number may stand for all.

    Raises:
        ArgumentError: naming the argument, if it has another shape or is not finite.
    """
    if isinstance(value, Tensor):
        value = value.detach().cpu().double()  # NumPy has no bfloat16
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:  # the last one of a gradient's tensors
        raise ArgumentError(f"{name}={value!r:.60}: must be numbers") from error
    if for_all and not array.ndim:
        array = np.full(shape, array)
    if shape[-1] == 1 and array.shape == shape[:-1]:
        array = array[..., np.newaxis]
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: has shape {list(array.shape)}, but must have {list(shape)}: one number for "
            "each level"
        )
    if not np.isfinite(array).all():
        raise ArgumentError(f"{name}={array[~np.isfinite(array)][0]}: must be finite")
    return array
