"""What an action of the Proposer means: which of N choices each of P problems is made of.

A choice is a number, whatever it stands for; the task turns choices into levels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Categorical, TensorSpec, Unbounded

from proposer_rl.streams import Streams

# From choices, int64 [K, P], to levels [K, P]; copy k draws from the k-th generator.
Generate = Callable[[Tensor, list[torch.Generator]], Any]


class Proposals(ABC):
    """The levels that actions of K copies stand for; a subclass defines the actions.

    Args:
        choices: number of choices N.
        generate: makes levels of choices.

    Raises:
        ValueError: for fewer than one choice.
    """

    def __init__(self, choices: int, generate: Generate) -> None:
        if choices < 1:
            raise ValueError(f"choices must be at least 1, got {choices}")
        self.choices = choices
        self._generate = generate

    @abstractmethod
    def action_spec(self, copies: int, problems: int, device: torch.device) -> TensorSpec:
        """The specification of actions, batch [K]."""

    @abstractmethod
    def draw(self, action: Tensor, problems: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Choices int64 [K, P]; what chance decides, copy k draws from the k-th generator."""

    def levels(
        self, action: Tensor, problems: int, streams: Sequence[Streams]
    ) -> tuple[Any, Tensor]:
        """Levels [K, P] of actions [K, ...], and their choices int64 [K, P].

        Both are drawn on the host, where level generators work; the device meanwhile finishes what
        it has to do.

        Args:
            action: of K copies.
            problems: number P of levels.
            streams: one for each copy, from which its choices and levels are drawn.
        """
        draws, levels = (
            [stream.generator(purpose) for stream in streams] for purpose in ("choices", "levels")
        )
        choices = self.draw(action.cpu(), problems, draws)
        return self._generate(choices, levels), choices


class ProblemChoices(Proposals):
    """An action names the choice of every problem: int64 [K, P] (the paper's Proposer, section 4).

    The P draws are independent, so that all batches of one policy look alike: the composition of
    a batch varies by about 1 / sqrt(P) only.

    Example:
        >>> proposals = ProblemChoices(6, generate=lambda choices, generators: choices)
        >>> proposals.action_spec(2, 4, torch.device("cpu")).shape
        torch.Size([2, 4])
    """

    def action_spec(self, copies: int, problems: int, device: torch.device) -> TensorSpec:
        """Categorical, int64 [K, P]."""
        return Categorical(self.choices, (copies, problems), dtype=torch.int64, device=device)

    def draw(self, action: Tensor, problems: int, generators: Sequence[torch.Generator]) -> Tensor:
        """The action itself: nothing is left to chance."""
        return action


class Mixture(Proposals):
    """An action is a mixture of choices from which the whole batch is drawn.

    Action a, float [K, D], stands for the mixture softmax(a @ directions), [K, N]: the zero action
    is the even mixture. Batches of one policy really differ then, and what the Solver gained can be
    credited to the mixture that it trained on. The draws are systematic: each choice occurs as
    often as its share of P problems says, rounded up or down, in random order.

    Args:
        directions: what each of D numbers adds to the log-shares of N choices, float [D, N]. The
            identity (D = N) makes every mixture possible; fewer directions are learnt faster.
        generate: makes levels of choices.

    Raises:
        ValueError: if ``directions`` is no matrix, or not finite.

    Example:
        Two choices, and one number that says how much more of the second there is:

        >>> import math
        >>> directions = torch.tensor([[0.0, 1.0]])
        >>> mixture = Mixture(directions, generate=lambda choices, generators: choices)
        >>> mixture.shares(torch.tensor([[0.0], [math.log(3)]]))
        tensor([[0.5000, 0.5000],
                [0.2500, 0.7500]])
        >>> choices = mixture.draw(torch.tensor([[math.log(3)]]), 8, [torch.Generator()])
        >>> choices.sum()  # the second occurs in 3/4 of 8 problems
        tensor(6)
    """

    def __init__(self, directions: Tensor, generate: Generate) -> None:
        if directions.ndim != 2 or min(directions.shape) < 1 or not directions.isfinite().all():
            raise ValueError(
                f"directions must be a finite matrix [D, N], got shape {list(directions.shape)}"
            )
        super().__init__(directions.shape[1], generate)
        self.directions = directions.cpu()

    def action_spec(self, copies: int, problems: int, device: torch.device) -> TensorSpec:
        """Unbounded, float [K, D]."""
        return Unbounded((copies, self.directions.shape[0]), device=device)

    def shares(self, action: Tensor) -> Tensor:
        """The mixture of actions [*B, D]: shares that add up to one, [*B, N]."""
        return (action @ self.directions).softmax(-1)

    def draw(self, action: Tensor, problems: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Systematic draws from the mixture of actions [K, D]."""
        return systematic_draw(self.shares(action), problems, generators)


def systematic_draw(shares: Tensor, count: int, generators: Sequence[torch.Generator]) -> Tensor:
    """Draw from mixtures so that nothing occurs more or less often than its share says.

    Args:
        shares: of N choices, float [K, N] on the CPU.
        count: number P of draws.
        generators: of the CPU; copy k draws from the k-th.

    Returns:
        int64 [K, P]: each choice as often as its share of P, rounded up or down, in random order.
    """
    cumulative = shares.double().cumsum(-1)
    offset = torch.stack([torch.rand(1, generator=g) for g in generators])
    order = torch.stack([torch.rand(count, generator=g).argsort() for g in generators])
    steps = torch.arange(count, dtype=torch.double)
    marks = (steps + offset) / count * cumulative[:, -1:]  # [K, P], one in each P-th
    choices = torch.searchsorted(cumulative, marks, right=True)
    return choices.clamp_(max=shares.shape[-1] - 1).gather(1, order)
