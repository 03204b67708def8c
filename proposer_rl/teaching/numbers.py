"""Numbers as loops and data sets give them: of any library, read as arrays on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from proposer_rl.settings import ArgumentError, shown
from proposer_rl.tasks.parameters import LARGEST


def as_numbers(
    name: str,
    value: Any,
    shape: tuple[int | None, ...] | None = None,
    low: float = -LARGEST,
    high: float = LARGEST,
    *,
    whole: bool = False,
    spread: bool = False,
    unknown: bool = False,
) -> NDArray[np.float64]:
    """Reads numbers of any library as float64.

    What is masked, None or missing is NaN, and refused as NaN is.

    Args:
        name: with which an error begins.
        value: a number, an array, a tensor, a series, or a list of these.
        shape: that they must have, with None for any length; None for any shape.
        low: the least that is allowed.
        high: the largest that is allowed; by default what float32 can hold.
        whole: whether they must be whole numbers.
        spread: whether one number may stand for all of the shape.
        unknown: whether NaN is allowed.

    Raises:
        ArgumentError: naming the value, and what is allowed.

    Example:
        >>> as_numbers("success", np.ma.array([0.5, 1.0], mask=[False, True]), (2,), 0, 1)
        Traceback (most recent call last):
        ...
        proposer_rl.settings.ArgumentError: success=nan: must be from 0 to 1
    """
    # One number by itself, as from an episode that has ended: an array takes ten times as long.
    inside = shape == () and type(value) in (int, float) and low <= value <= high
    if inside and (not whole or value % 1 == 0):
        return np.float64(value)  # type: ignore[return-value]
    try:
        array = _array(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ArgumentError(f"{name}={shown(value)}: must be numbers of float32") from error
    if shape is not None:
        if spread and not array.ndim:
            array = np.full([one or 0 for one in shape], array)
        fits = [wanted in (None, length) for wanted, length in zip(shape, array.shape)]  # noqa: B905
        if len(shape) != array.ndim or not all(fits):
            wanted = "[" + ", ".join("n" if one is None else f"{one}" for one in shape) + "]"
            raise ArgumentError(f"{name}: has shape {[*array.shape]}, but must have {wanted}")
    wrong = ~((array >= low) & (array <= high))  # NaN, too
    if whole:
        wrong |= array.round() != array
    if unknown:
        wrong &= ~np.isnan(array)
    if wrong.any():
        allowed = "finite in float32" if high == LARGEST else f"from {low:g} to {high:g}"
        kind = "a whole number " if whole else ""
        raise ArgumentError(f"{name}={array[wrong][0]}: must be {kind}{allowed}")
    return array


def _array(value: Any) -> NDArray[np.float64]:
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value if value.is_complex() else value.double()).numpy()  # of bfloat16, too
    elif isinstance(value, list | tuple):
        special = Tensor, np.ma.MaskedArray
        value = [_array(one) if isinstance(one, special) else one for one in value]
    array = np.asarray(value)
    if array.dtype.kind not in "biufO":  # such as complex numbers and texts
        raise TypeError(array.dtype)
    array = array.astype(np.float64)
    if isinstance(value, np.ma.MaskedArray):
        array[np.ma.getmaskarray(value)] = np.nan
    return array


def as_ids(name: str, value: Any) -> NDArray[np.int64]:
    """Reads tickets or items [n], which are integers: float32 would confuse large ones.

    Raises:
        ArgumentError: if they are none.
    """
    array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    integers = array.dtype.kind in "iu" and array.ndim < 2 and not np.ma.is_masked(value)
    if array.size and not integers:
        raise ArgumentError(f"{name}={shown(value)}: must be whole numbers [n]")
    return array.reshape(-1).astype(np.int64)
