"""Results as loops tell them, and as curricula observe them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.settings import ArgumentError, shown
from proposer_rl.tasks.parameters import LARGEST

RESULTS = ("return", "success", "score", "episodes", "steps")
COUNTS = ("episodes", "steps")
MOST = 1e15  # of these, which float64 still counts one by one


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
        ArgumentError: naming the argument, if it has another shape or a number that is not finite
            in float32, or not allowed.
    """
    if isinstance(value, Tensor):
        value = value.detach().cpu().double()  # NumPy has no bfloat16
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        # RuntimeError: tensors with a gradient; OverflowError: an integer beyond float64.
        raise ArgumentError(f"{name}={shown(value)}: must be numbers of float32") from error
    if for_all and not array.ndim:
        array = np.full(shape, array)
    if shape[-1] == 1 and array.shape == shape[:-1]:
        array = array[..., np.newaxis]
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: has shape {list(array.shape)}, but must have {list(shape)}: one number for "
            "each level"
        )
    if (wrong := array[~(np.abs(array) <= LARGEST)]).size:  # results are kept in float32
        raise ArgumentError(f"{name}={wrong[0]}: must be finite in float32")
    check_values(name, array)
    return array


def check_values(name: str, array: NDArray[np.float64]) -> None:
    """Refuse what is no share of successes, or no count.

    Raises:
        ArgumentError: naming the argument.
    """
    if name == "success":
        wrong, allowed = array[(array < 0) | (array > 1)], "from 0 to 1"
    elif name in COUNTS:
        least = int(name == "episodes")
        wrong = array[(array < least) | (array > MOST) | (array % 1 != 0)]
        allowed = f"a whole number, at least {least} and at most {MOST:g}"
    else:
        return
    if wrong.size:
        raise ArgumentError(f"{name}={wrong[0]:g}: must be {allowed}")
