"""Turns the Proposer's actions into bins: one of N for each of P levels.

A bin is a number; the space of the task turns bins into levels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical, TensorSpec, Unbounded

from proposer_rl.streams import Streams
from proposer_rl.task import Space, refuse_unfit_bins


class Actions(ABC):
    """Turns the actions of K students into levels; subclasses define what an action is.

    Args:
        space: the bins, and the levels in them.

    Raises:
        ArgumentError: if there is one bin only.
    """

    def __init__(self, space: Space) -> None:
        refuse_unfit_bins(space)
        self.space = space
        self.bins = space.size

    @abstractmethod
    def spec(self, students: int, batch_size: int, device: torch.device) -> TensorSpec:
        """Returns the specification of actions [K, ...], each for a batch of P levels."""

    @abstractmethod
    def draw(
        self, action: Tensor, batch_size: int, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """Returns bins int64 [K, P]; student k draws from the k-th generator where it draws."""

    def levels(
        self, action: Tensor, batch_size: int, streams: Sequence[Streams]
    ) -> tuple[Any, Tensor]:
        """Draws levels [K, P] for actions [K, ...]; returns them and their bins int64 [K, P].

        Both are drawn on the host, where level generators work, while the device finishes its work.

        Args:
            action: of K students.
            batch_size: number P of levels.
            streams: of each student, to draw its bins and levels.
        """
        draws, levels = (
            [stream.generator(purpose) for stream in streams] for purpose in ("choices", "levels")
        )
        choices = self.draw(action.cpu(), batch_size, draws)
        return self.space.generate(choices, levels), choices


class ProblemChoices(Actions):
    """Lets an action name the bin of every level: int64 [K, P] (the paper's Proposer, section 4).

    The P draws are independent, so all batches of one policy look alike: the composition of a batch
    only varies by about 1 / sqrt(P).

    Example:
        Until levels are generated, only the number of the space's bins matters:

        >>> from types import SimpleNamespace
        >>> choices = ProblemChoices(SimpleNamespace(size=4))
        >>> choices.draw(torch.tensor([[0, 3, 3]]), 3, [torch.Generator()])
        tensor([[0, 3, 3]])
    """

    def spec(self, students: int, batch_size: int, device: torch.device) -> TensorSpec:
        """Returns a categorical specification, int64 [K, P]."""
        return Categorical(self.bins, (students, batch_size), dtype=torch.int64, device=device)

    def draw(
        self, action: Tensor, batch_size: int, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """Returns the action itself, repeated if the batch is larger, without drawing."""
        return action.repeat(1, -(-batch_size // action.shape[1]))[:, :batch_size]


class Mixture(Actions):
    """Lets an action be a mixture of bins from which the whole batch is drawn.

    Action a, float [K, D], stands for the mixture softmax(a @ directions), [K, N]; the zero action
    is uniform. With mixtures the batches of one policy really differ, so the Solver's gain can be
    credited to the mixture. Bins are drawn by :func:`systematic_draw`.

    Args:
        space: the bins, and the levels in them.
        directions: what each of D numbers adds to the log-shares of N bins, float [D, N]; None for
            the space's coordinates, so that a number shifts the mixture towards one end of an axis.
            The identity (D = N) makes every mixture possible; fewer numbers are learnt faster.

    Example:
        Three bins along one axis, and an action that prefers its upper end:

        >>> from types import SimpleNamespace
        >>> space = SimpleNamespace(size=3, coordinates=torch.tensor([[-1.0], [0.0], [1.0]]))
        >>> mixture = Mixture(space)
        >>> mixture.shares(torch.tensor([[2.0]]))
        tensor([[0.0159, 0.1173, 0.8668]])
        >>> mixture.draw(torch.tensor([[0.0]]), 6, [torch.Generator()])[0].bincount()
        tensor([2, 2, 2])
    """

    def __init__(self, space: Space, directions: Tensor | None = None) -> None:
        super().__init__(space)
        self.directions = (space.coordinates.T if directions is None else directions).cpu()

    def spec(self, students: int, batch_size: int, device: torch.device) -> TensorSpec:
        """Returns an unbounded specification, float [K, D]."""
        return Unbounded((students, self.directions.shape[0]), device=device)

    def shares(self, action: Tensor) -> Tensor:
        """Returns the mixtures of actions [*B, D] as shares [*B, N] that add up to one."""
        return (action @ self.directions).softmax(-1)

    def draw(
        self, action: Tensor, batch_size: int, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """Draws bins int64 [K, P] systematically from the mixtures of actions [K, D]."""
        return systematic_draw(self.shares(action), batch_size, generators)


def systematic_draw(shares: Tensor, count: int, generators: Sequence[torch.Generator]) -> Tensor:
    """Draws bins so that each occurs ``count`` times its share, rounded up or down.

    Systematic sampling: one random offset, then a mark in each ``count``-th part of the cumulated
    shares; in random order.

    Args:
        shares: float [K, N], on the CPU.
        count: number P of draws.
        generators: K of them.

    Returns:
        int64 [K, P].

    Example:
        >>> choices = systematic_draw(torch.tensor([[0.25, 0.75]]), 8, [torch.Generator()])
        >>> choices.sum()  # the second occurs in 3/4 of 8 draws
        tensor(6)
    """
    cumulative = shares.double().cumsum(-1)
    offset = torch.stack([torch.rand(1, generator=g) for g in generators])
    order = torch.stack([torch.rand(count, generator=g).argsort() for g in generators])
    steps = torch.arange(count, dtype=torch.double)
    marks = (steps + offset) / count * cumulative[:, -1:]  # [K, P], one in each P-th
    choices = torch.searchsorted(cumulative, marks, right=True)
    return choices.clamp_(max=shares.shape[-1] - 1).gather(1, order)
