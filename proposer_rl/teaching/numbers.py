"""Reads numbers of any library as arrays on the CPU, and checks them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from proposer_rl.settings import ArgumentError, plain, shown
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
    """Reads numbers of any library as float64, and checks their shape and range.

    Masked and missing entries and None become NaN.

    Args:
        name: of the argument, for errors.
        value: a number, an array, a tensor, a series, or a list of these.
        shape: the required shape, with None for any length; None for any shape.
        low: the smallest allowed number.
        high: the largest; by default the largest finite one of float32.
        whole: whether only whole numbers are allowed.
        spread: whether one number may stand for all of the shape.
        unknown: whether NaN is allowed.

    Raises:
        ArgumentError: naming the argument, the value and what is allowed.

    Example:
        >>> as_numbers("success", np.ma.array([0.5, 1.0], mask=[False, True]), (2,), 0, 1)
        Traceback (most recent call last):
        ...
        proposer_rl.settings.ArgumentError: success=nan: must be from 0 to 1
    """
    # A fast path for the numbers of a single episode: an array takes ten times as long.
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
    """Returns numbers as an array, and raises a TypeError for complex numbers, texts and so on."""
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value if value.is_complex() else value.double()).numpy()  # also of bfloat16
    elif isinstance(value, list | tuple):
        special = Tensor, np.ma.MaskedArray
        value = [_array(one) if isinstance(one, special) else one for one in value]
    array = np.asarray(value)
    if array.dtype.kind not in "biufO":
        raise TypeError(array.dtype)
    array = array.astype(np.float64)
    if isinstance(value, np.ma.MaskedArray):
        array[np.ma.getmaskarray(value)] = np.nan
    return array


def as_ids(name: str, value: Any, count: int | None = None) -> NDArray[np.int64]:
    """Reads tickets, or places of items, [n]: integers, since float32 confuses large numbers.

    Args:
        name: of the argument, for errors.
        value: a number, or an array, a tensor, a series, a list, a range or a set of them.
        count: that all must be below; None for tickets.

    Raises:
        ArgumentError: if one is no integer, or is not below ``count``.
    """
    given = [*value] if isinstance(value, set) else value
    array = np.asarray(given.detach().cpu() if isinstance(given, Tensor) else given)
    fits = array.dtype.kind in "iu" and array.ndim < 2 and not np.ma.is_masked(value)
    if fits and count is not None:
        fits = bool(((array >= 0) & (array < count)).all())
    if array.size and not fits:
        allowed = "" if count is None else f" from 0 to {count - 1}"
        raise ArgumentError(f"{name}={shown(plain(given))}: must be whole numbers{allowed}, [n]")
    return array.reshape(-1).astype(np.int64)
