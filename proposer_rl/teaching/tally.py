"""Counts for a teacher's log: levels that were handed out, and their results."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from proposer_rl.task import Levels
from proposer_rl.tasks.parameters import ParameterSpace
from proposer_rl.teaching.spaces import Items

MOST_PARTS = 64  # parts of a data set in which items are counted


class Tally:
    """Counts a teacher's levels and results between two readings.

    Args:
        space: the space of the levels, or a task.
    """

    def __init__(self, space: Any) -> None:
        self._texts, self._bins = _bins(space.space)
        self._clear()

    def count(self, levels: Levels) -> None:
        """Counts levels [n] that were handed out."""
        self._proposed += len(levels)
        for name, bins in self._bins(levels).items():
            self._drawn[name] += bins.bincount(minlength=len(self._texts[name]))

    def returned(self, tickets: int, returns: Any, success: Any = None) -> None:
        """Counts the results of tickets, arrays or NumPy's scalars."""
        self._returned += tickets
        for name, values in (("return", returns), ("success", success)):
            if values is not None:
                total, number = self._sums.get(name, (0.0, 0))
                self._sums[name] = total + float(values.sum()), number + values.size

    def dropped(self, tickets: int) -> None:
        """Counts tickets that were given up."""
        self._dropped += tickets

    def read(self, out: int) -> dict[str, Any]:
        """Returns the counts, for JSON, and resets them.

        Args:
            out: number of levels that are out now.
        """
        means = {name: total / number for name, (total, number) in self._sums.items()}
        found = {
            "proposed": self._proposed,
            "told": self._returned,
            "dropped": self._dropped,
            "out": out,
            "mean_return": means.get("return"),
            "mean_success": means.get("success"),
            "drawn": {
                name: dict(zip(texts, self._drawn[name].tolist(), strict=True))
                for name, texts in self._texts.items()
            },
        }
        self._clear()
        return found

    def _clear(self) -> None:
        self._proposed = self._returned = self._dropped = 0
        self._sums: dict[str, tuple[float, int]] = {}
        self._drawn = {
            name: torch.zeros(len(t), dtype=torch.int64) for name, t in self._texts.items()
        }


def _bins(space: Any) -> tuple[dict[str, list[str]], Callable[[Levels], dict[str, Tensor]]]:
    """Returns the names of the bins along each axis, and a function that finds levels in them.

    The function returns for levels [n] the bin along each axis, int64 [n]. There is no axis if the
    space has neither parameters nor items.
    """
    if isinstance(space, ParameterSpace):
        return {name: part.texts for name, part in space.bins.items()}, lambda levels: {
            name: torch.searchsorted(part.borders, levels[name].double().cpu())
            for name, part in space.bins.items()
        }
    if isinstance(space, Items):
        parts = min(space.size, MOST_PARTS)
        ends = [-(-space.size * part // parts) for part in range(parts + 1)]
        texts = [f"{a}" if b - a == 1 else f"{a} to {b - 1}" for a, b in pairwise(ends)]
        return {"item": texts}, lambda levels: {
            "item": (levels["item"].cpu() * parts // space.size).clamp(0, parts - 1)
        }
    return {}, lambda levels: {}  # of others curricula log histograms
