"""Turns features of items and levels into tables of numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from proposer_rl.curricula.belief import WIDEST
from proposer_rl.settings import ArgumentError
from proposer_rl.teaching.numbers import as_numbers

MOST_TEXTS = 256  # different texts of a category
OUTLIER = 3.0  # standard deviations at which numbers of wide tables are cut off
ANSWERS = 16.0  # number of answers that a pass rate is assumed to be the mean of


class Table(NamedTuple):
    """The features of N items.

    Attributes:
        numbers: float or int64 [N, D]; a column of texts becomes one column for each, 0 or 1.
        categories: the number of each item's combination of texts, int64 [N]; None without texts.
    """

    numbers: Tensor
    categories: Tensor | None


def number_table(features: Any) -> Tensor:
    """Returns numbers [N, D] of any library as a tensor."""
    array = hasattr(features, "__array__") and not isinstance(features, Tensor)
    if isinstance(features, np.ma.MaskedArray):
        features = np.ma.filled(features.astype(np.float64), np.nan)
    table = torch.as_tensor(np.array(features) if array else features)
    return table if table.is_floating_point() else table.long()  # differences of int8 overflow


def item_table(features: Any) -> Table:
    """Reads features of items, given as a table, as columns by name, or as rows.

    A column is a category if its first entry that is not missing is a text.

    Raises:
        ArgumentError: naming a column that has neither numbers nor few texts.
    """
    columns = _columns(features)
    texts = [_begins_with_text(column) for column in columns.values()]
    if not columns or (not any(texts) and hasattr(features, "__array__")):
        return Table(number_table(features).detach().cpu(), None)
    parts, codes = [], []
    for (name, column), is_text in zip(columns.items(), texts, strict=True):
        if not is_text:
            parts.append(_numbers(f"features.{name}", column))
            continue
        found, code = np.unique([*map(str, column)], return_inverse=True)
        if len(found) > MOST_TEXTS:
            raise ArgumentError(
                f"features.{name}: has {len(found):,} different texts, but a category may have "
                f"{MOST_TEXTS}; describe other texts by numbers"
            )
        codes.append(torch.from_numpy(code.reshape(-1)))
        parts.append(torch.nn.functional.one_hot(codes[-1], len(found)).double())
    categories = torch.stack(codes, 1).unique(dim=0, return_inverse=True)[1] if codes else None
    return Table(torch.cat(parts, 1), categories)


def _columns(features: Any) -> dict[str, Any]:
    """Returns columns by name, or by place for rows with texts; nothing if all are numbers."""
    is_series = getattr(features, "ndim", 2) == 1 and not isinstance(features, Mapping)
    if hasattr(features, "items") and not is_series:
        return {str(name): column for name, column in features.items()}
    if isinstance(features, Tensor) or not _begins_with_text(features):
        return {}
    rows = [[row] if isinstance(row, str) else [*row] for row in features]
    return {str(place): column for place, column in enumerate(zip(*rows, strict=True))}


def _begins_with_text(cells: Any) -> bool:
    """Returns whether the first cell that is not missing, or one in the first row, is a text."""
    there = (cell for cell in cells if not _is_missing(cell)) if hasattr(cells, "__iter__") else ()
    first = next(iter(there), None)
    inner = first if isinstance(first, list | tuple | np.ndarray) else [first]
    return any(isinstance(cell, str) for cell in inner)


def _is_missing(cell: Any) -> bool:
    return cell is None or (isinstance(cell, float) and math.isnan(cell))


def _numbers(name: str, column: Any) -> Tensor:
    cells = column if hasattr(column, "__array__") else [*column]
    return torch.from_numpy(as_numbers(name, cells)).reshape(len(cells), -1)


def ranks(table: Tensor) -> Tensor:
    """Returns the ranks of numbers [N, D] in their columns, from -1 to 1 with mean 0, float32.

    Equal numbers share the middle of their ranks, so that neither an outlier nor a scale matters,
    and a column of two values has two.

    Example:
        >>> ranks(torch.tensor([[1.0], [1e9], [1.0], [3.0]])).flatten()
        tensor([-0.5000,  0.7500, -0.5000,  0.2500])
    """
    columns = table.double().mT.contiguous()
    rising, order = columns.sort()
    below, upto = (torch.searchsorted(rising, rising, right=right) for right in (False, True))
    middle = ((below + upto) / len(table) - 1).float()
    return torch.empty_like(middle).scatter_(1, order, middle).mT.contiguous()


def few_columns(table: Tensor, others: int = 0) -> Tensor:
    """Returns ranks [N, D]; for wide tables, those of the first principal components.

    Args:
        table: finite numbers [N, D].
        others: number of further columns that a belief gets, for which to leave room.

    Returns:
        float32 [N, min(D, WIDEST - others)].
    """
    most = WIDEST - others
    if table.shape[1] <= most:
        return ranks(table)
    own = table.float() - table.float().mean(0)
    own = (own / own.std(0).clamp_min(1e-12)).clamp(-OUTLIER, OUTLIER)
    vectors = torch.linalg.eigh((own.mT @ own).double()).eigenvectors[:, -most:].flip(1)
    return ranks(own @ vectors.float())


def rate_columns(rates: Tensor) -> Tensor:
    """Returns the ranks of pass rates [N], float32 [N, 1]; with NaN a second column marks those."""
    missing = rates.isnan()
    known = torch.zeros(len(rates), 1)
    known[~missing] = ranks(rates[~missing].unsqueeze(1))
    return torch.cat([known, ranks(missing.double()[:, None])], 1) if missing.any() else known


def expected_log_odds(rates: Tensor) -> Tensor:
    """Returns the log odds of pass rates, each smoothed as a mean of 16 answers: float64 [N].

    Missing rates, NaN, get the mean of the others.
    """
    odds = ((rates.double() * ANSWERS + 0.5) / (ANSWERS + 1)).logit()
    return odds.where(~odds.isnan(), odds.nanmean().nan_to_num(0.0))
