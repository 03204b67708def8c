"""What the meta-environment trains: K learners side by side, of any kind."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.learning import Update


class Learner(Protocol):
    """K learners, each of which trains on P levels at every update as if it were alone.

    :class:`~proposer_rl.learning.PPO` of a population is one; ``examples/own_learner.py`` shows one
    that is not.

    Attributes:
        env: with ``batch_size`` [K, P], ``device``, and ``set_levels(levels [K, P])``, which says
            what the next update trains on.
        agent: what the task's ``performance`` and ``probe`` take.
        copies: the number K.
        horizon: environment steps of an update on one level.
    """

    env: Any
    agent: Any

    @property
    def copies(self) -> int | None: ...  # noqa: D102

    @property
    def horizon(self) -> int: ...  # noqa: D102

    def update(self, generators: list[torch.Generator]) -> Update:
        """One update on the levels that are set; learner k draws from the k-th generator."""

    def check(self, first: int = 0) -> None:
        """Raise a DivergedError if a number of the last update is not finite.

        Args:
            first: number of the first learner, by which they are named.
        """

    def snapshot(self) -> TensorDict:
        """A copy of all that an update changes, batch [K]."""

    def restore(self, snapshot: TensorDictBase) -> None:
        """Put a snapshot [K] back."""
