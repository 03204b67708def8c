"""Terrain levels: one row up after a success, one down after a failure."""

from __future__ import annotations

from functools import partial
from math import prod
from typing import Annotated, Any

import torch
from annotated_types import Ge
from tensordict import TensorDict, TensorDictBase

from proposer_rl.curricula.batches import levels_in
from proposer_rl.curricula.bins import CountingCurriculum, Measure
from proposer_rl.curricula.contract import Batch
from proposer_rl.curricula.points import refuse_crossed
from proposer_rl.curricula.student import Student
from proposer_rl.settings import ArgumentError, checked
from proposer_rl.streams import Streams
from proposer_rl.task import Space, refuse_unfit_bins


class RowsCurriculum(CountingCurriculum):
    """Moves robots between rows of growing difficulty, by the rule of ``legged_gym``.

    A robot with a result of at least ``upper`` in row r gets a level in row r + 1 next, one with a
    result below ``lower`` a level in row r - 1, and others stay; row 0 is the lowest. After the
    last row a robot gets a row drawn uniformly (Rudin et al. 2021, "Learning to Walk in Minutes
    Using Massively Parallel Deep Reinforcement Learning", arXiv 2109.11978).

    The next rows wait in a queue, in the order in which results come back, and the next proposals
    take them. When the queue is empty, as at first, rows from 0 to ``start`` are drawn uniformly.
    The other parameters of a level are uniform.

    Args:
        space: that has the bins.
        row: the axis whose bins are the rows; None for the axis named ``row`` or, if there is
            none, the first axis.
        start: the highest row to begin in, if there are as many.
        lower: a robot goes down if its result is below this.
        upper: a robot goes up if its result is at least this.
        measure: result of a level, ``"success"`` or ``"return"``.

    Raises:
        ArgumentError: for an unknown axis, one of a single row, or ``lower`` above ``upper``.
    """

    state = ("_queue", "_counts", "_last")

    @checked
    def __init__(
        self,
        space: Space,
        *,
        row: str | None = None,
        start: Annotated[int, Ge(0)] = 5,
        lower: float = 0.5,
        upper: float = 0.5,
        measure: Measure = "success",
    ) -> None:
        refuse_crossed(lower, upper)
        names = [*space.axes]
        name = row or ("row" if "row" in names else names[0])
        if name not in names:
            raise ArgumentError(f"row={name}: unknown; there are: {', '.join(names)}")
        sizes = [len(values) for values in space.axes.values()]
        axis = names.index(name)
        self._rows = sizes[axis]
        if self._rows < 2:
            raise ArgumentError(f"row={name}: has a single row; give the axis bins")
        refuse_unfit_bins(space)
        # The number of a bin is (before * rows + row) * after + rest.
        self._before, self._after = prod(sizes[:axis]), prod(sizes[axis + 1 :])
        super().__init__(space)
        self._start = min(start, self._rows - 1)
        self.required_results = ("success",) if measure == "success" else ()
        self._lower, self._upper, self._measure = lower, upper, measure
        self._last = torch.zeros(0, dtype=torch.int64)  # rows of the last batch, [n]
        self._queue = torch.zeros(0, dtype=torch.int64)  # next rows, [m]

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Returns levels [n] in the rows that are next in the queue."""
        next_rows, self._queue = self._queue[:count], self._queue[count:]
        uniform = partial(torch.randint, size=(count,), generator=rng.generator("choices"))
        first, anywhere = uniform(self._start + 1), uniform(self._rows)
        rows = torch.cat([next_rows, first[len(next_rows) :]])
        rows = rows.where(rows < self._rows, anywhere)
        self._last = rows
        bins = (uniform(self._before) * self._rows + rows) * self._after + uniform(self._after)
        levels = levels_in(self.space, bins, rng.generator("levels"))
        return Batch(levels, TensorDict({"bins": bins, "row": rows}, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Appends the next rows of the robots to the queue."""
        super().observe(student, batch, outcome)
        reached = outcome[self._measure].double().cpu()
        move = (reached >= self._upper).long() - (reached < self._lower).long()
        self._queue = torch.cat([self._queue, (batch.notes["row"] + move).clamp(min=0)])

    def log(self) -> dict[str, Any]:
        """Returns counts of levels by bin, and the mean row and the share of the last row.

        Rows count from 0.
        """
        if not len(self._last):
            return {}
        return {
            "histogram": self.histogram(),
            "mean_row": float(self._last.double().mean()),
            "last_row": float((self._last == self._rows - 1).double().mean()),
        }
