"""Bases of curricula that draw from the bins of a space, and measurements of each bin."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula.batches import levels_in
from proposer_rl.curricula.contract import Batch, Curriculum
from proposer_rl.curricula.student import Student
from proposer_rl.meta.actions import systematic_draw
from proposer_rl.settings import Count, checked
from proposer_rl.streams import Streams
from proposer_rl.task import NoSuccessError, Space, refuse_unfit_bins

Measure = Literal["success", "return"]


class CountingCurriculum(Curriculum):
    """Counts how many levels of each bin were observed, for the log.

    The notes of its batches have the ``bins`` of the levels, int64 [n].

    Args:
        space: that has the bins.
    """

    def __init__(self, space: Space) -> None:
        self.space = space
        self._counts = torch.zeros(space.size, dtype=torch.int64)

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Counts the levels."""
        self._counts += batch.notes["bins"].bincount(minlength=self.space.size)

    def histogram(self) -> list[Any]:
        """Returns the counts since the last call, as lists nested along the axes of the space."""
        counts, self._counts = self._counts, torch.zeros_like(self._counts)
        return along_axes(counts, self.space)


class BinCurriculum(CountingCurriculum):
    """Draws batches from shares of the bins, which regular scoring passes renew.

    A subclass defines the scoring pass, the shares, and what to learn from outcomes.

    Args:
        space: that has the bins.
        every: number of batches between two scoring passes.
    """

    shown: ClassVar[Sequence[str]] = ("score",)
    """The scores to log."""
    state: ClassVar[tuple[str, ...]] = ("scores", "_counts", "_proposed")

    @checked
    def __init__(self, space: Space, *, every: Count) -> None:
        refuse_unfit_bins(space)
        super().__init__(space)
        self._every, self._proposed = every, 0
        self.scores: dict[str, Tensor] = {}  # from which shares are computed, each [N], on the CPU

    @abstractmethod
    def score(self, student: Student, count: int, rng: Streams) -> None:
        """Renews :attr:`scores` for batches of ``count`` levels."""

    @abstractmethod
    def shares(self) -> Tensor:
        """Returns the shares of the bins in the next batch: float [N] with a sum of one."""

    def learn(self, bins: Tensor, outcome: TensorDictBase) -> None:
        """Learns from the outcome [m] of levels in these bins, int64 [m]."""

    def propose(self, student: Student, count: int, rng: Streams) -> Batch:
        """Draws levels [n] systematically from the shares of the bins."""
        if self._proposed % self._every == 0:
            self.score(student, count, rng)
        self._proposed += 1
        bins = systematic_draw(self.shares()[None], count, [rng.generator("choices")])[0]
        levels = levels_in(self.space, bins, rng.generator("levels"))
        return Batch(levels, TensorDict({"bins": bins}, [count]))

    def observe(self, student: Student, batch: Batch, outcome: TensorDictBase) -> None:
        """Counts the levels and learns from their outcome."""
        super().observe(student, batch, outcome)
        self.learn(batch.notes["bins"], outcome)

    def log(self) -> dict[str, Any]:
        """Returns counts of levels by bin, the scores, and how even the shares are."""
        if not self.scores:
            return {}
        shares = self.shares()
        return {
            "histogram": self.histogram(),
            **{name: along_axes(self.scores[name], self.space) for name in self.shown},
            "share_entropy": float(torch.special.entr(shares).sum()),
            "effective_bins": float(1 / shares.square().sum()),
        }


def along_axes(values: Tensor, space: Space) -> list[Any]:
    """Nests numbers [*B, N] of a space's bins into lists along its axes."""
    return values.unflatten(-1, [len(axis) for axis in space.axes.values()]).tolist()


def means_of_bins(choices: Tensor, values: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Returns the mean value of the levels in each bin, and how many levels each bin had.

    Args:
        choices: bins of the levels, int64 [n].
        values: of the levels, float [n].
        size: number N of bins.

    Returns:
        float [N], NaN where there was no level; float [N].

    Example:
        >>> means_of_bins(torch.tensor([2, 0, 2]), torch.tensor([0.0, 1.0, 1.0]), 3)
        (tensor([1.0000,    nan, 0.5000]), tensor([1., 0., 2.]))
    """
    none = values.new_zeros(size)
    counts = none.scatter_add(0, choices, torch.ones_like(values))
    return none.scatter_add(0, choices, values) / counts, counts


class Probes:
    """Measures the student's performance on fixed levels of every bin.

    The levels are drawn once, from the random streams of the first proposal. The measurement is
    exact if the student's performance is.

    Args:
        space: that has the bins.
        count: number of levels of each bin.
        measure: ``"success"`` or ``"return"``.
    """

    def __init__(self, space: Space, count: int, measure: Measure) -> None:
        self._space, self._count, self.measure = space, count, measure
        self._drawn_from: list[Any] = []
        self._levels: Any = None

    def performance(self, student: Student, rng: Streams) -> Tensor:
        """Measures the student's mean performance in each bin: float32 [N], on the CPU.

        Raises:
            NoSuccessError: if success is measured and the task has none.
        """
        size = self._space.size
        if self._levels is None:
            self._drawn_from = self._drawn_from or rng.address
            bins = torch.arange(size).repeat_interleave(self._count)
            draw = Streams(*self._drawn_from).generator("probes")
            self._levels = levels_in(self._space, bins, draw)
        performance = student.performance(self._levels, rng.generator("probe_episodes"))
        if self.measure not in performance.keys():
            raise NoSuccessError(
                f"measure={self.measure}: this task tells no success, only the return; set "
                "measure=return"
            )
        reached = performance[self.measure].unflatten(-1, (size, self._count)).mean(-1)  # [N]
        return reached.float().cpu()

    def state_dict(self) -> dict[str, Any]:
        """Returns the address of the random streams from which the levels are drawn."""
        return {"drawn_from": list(self._drawn_from)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned; the levels are then drawn again."""
        self._levels = None
        self._drawn_from = list(state["drawn_from"])
