"""What curricula share that draw each Solver's batch from the bins of the task's space."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from proposer_rl.curricula.base import Curriculum, Improvement, Proposal
from proposer_rl.curricula.checks import whole
from proposer_rl.curricula.choice import Choice
from proposer_rl.learning import PPO
from proposer_rl.meta.actions import systematic_draw
from proposer_rl.streams import Streams
from proposer_rl.task import Task


class BinCurriculum(Curriculum):
    """Looks at the Solvers now and then, and draws the batches between two looks from shares.

    A subclass says what a look is and what the shares are made of.

    Args:
        task: whose space has the bins.
        every: updates between two looks at the Solvers.
        choice: of the levels that are trained on, among several times as many; None for all.

    Raises:
        ValueError: if a number is out of range.
    """

    told: ClassVar[Sequence[str]] = ("score",)
    """Scores that are told of each cycle."""

    def __init__(self, task: Task, *, every: int, choice: Choice | None = None) -> None:
        self.task = task
        self._choice = choice
        self._every = whole("every", every, 1)
        self.begin()

    def begin(self) -> None:
        """Forget the last Solver's scores."""
        self.scores: dict[str, Tensor] = {}  # what the shares come from, each [K, N], on the CPU
        self._proposed = torch.zeros(self.task.space.size, dtype=torch.int64)

    @abstractmethod
    def look(self, learner: PPO, streams: Sequence[Streams]) -> tuple[int, int]:
        """Look at the Solvers; return the frames and evaluations that it took for each."""

    @abstractmethod
    def shares(self) -> Tensor:
        """Of the bins in the next batch, float [K, N]; they add up to one."""

    def propose(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Proposal:
        """Levels [K, P], drawn systematically from the shares, or chosen among such."""
        first = not self.scores
        cost = self.look(learner, streams) if first or updates % self._every == 0 else (0, 0)
        draws, levels = ([s.generator(key) for s in streams] for key in ("choices", "levels"))
        count = self.task.batch_size * (self._choice.times if self._choice else 1)
        self._choices = systematic_draw(self.shares(), count, draws)
        proposal = Proposal(self.task.space.generate(self._choices, levels), *cost)
        if self._choice:
            index, proposal = self._choice(learner, proposal, streams)
            self._choices = self._choices.gather(1, index)
        self._proposed += self._choices.flatten().bincount(minlength=len(self._proposed))
        return proposal

    def improve(self, learner: PPO, updates: int, streams: Sequence[Streams]) -> Improvement:
        """Tell of the last cycle: counts, and of each Solver scores and how even its shares are."""
        if not self.scores:
            return Improvement()
        shape = [len(values) for values in self.task.space.axes.values()]
        shares = self.shares()
        metrics = {
            "histogram": self._proposed.view(shape).tolist(),
            **{name: self.scores[name].unflatten(-1, shape).tolist() for name in self.told},
            "share_entropy": torch.special.entr(shares).sum(-1).tolist(),
            "effective_bins": (1 / shares.square().sum(-1)).tolist(),
        }
        self._proposed = torch.zeros_like(self._proposed)
        return Improvement(metrics)

    def state_dict(self) -> dict[str, Any]:
        """The scores, and how often each bin was proposed in the cycle."""
        return {"scores": dict(self.scores), "proposed": self._proposed.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with them."""
        self.scores = dict(state["scores"])
        self._proposed = state["proposed"].clone()


def means_of_bins(choices: Tensor, values: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Mean value of the levels of each bin, and how many levels it had.

    Args:
        choices: bins of the levels, int64 [K, P].
        values: of the levels, float [K, P].
        size: number N of bins.

    Returns:
        float [K, N], NaN where there was no level; float [K, N].

    Example:
        >>> choices, values = torch.tensor([[2, 0, 2]]), torch.tensor([[0.0, 1.0, 1.0]])
        >>> means_of_bins(choices, values, 3)
        (tensor([[1.0000,    nan, 0.5000]]), tensor([[1., 0., 2.]]))
    """
    none = values.new_zeros(len(values), size)
    counts = none.scatter_add(1, choices, torch.ones_like(values))
    return none.scatter_add(1, choices, values) / counts, counts
