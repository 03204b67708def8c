"""The K copies of a cycle: rolled out, and one of them taken out again, wherever they are."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDictBase

from proposer_rl.learning.ppo import PPO, Update
from proposer_rl.meta.env import ReplayError, SolverTrainingEnv
from proposer_rl.streams import Streams

Pause = Callable[[], None]


class Trained(NamedTuple):
    """One copy at the end of its episode.

    Attributes:
        solver: its snapshot, batch [1].
        levels: of its last update, [1, P].
        update: its last update, [1, P, T]; the metrics are means over all copies.
    """

    solver: TensorDictBase
    levels: Any
    update: Update


class Copies(Protocol):
    """Where the copies of the Solver are trained while the Proposer acts on them."""

    def roll_out(
        self,
        solver: TensorDictBase,
        streams: Streams,
        pause: Pause | None = None,
        begun: dict[str, Any] | None = None,
    ) -> TensorDictBase:
        """One episode of K copies of a Solver.

        Args:
            solver: a snapshot of one Solver, batch [].
            streams: of the cycle.
            pause: see :meth:`~proposer_rl.meta.env.SolverTrainingEnv.fork`.
            begun: what :meth:`episode` returned, to go on from there.

        Returns:
            The Proposer's rollout, [K, T], ready for :meth:`~proposer_rl.learning.ppo.PPO.optimise`.
        """

    def episode(self) -> dict[str, Any] | None:
        """What is needed to go on with a begun episode; None where it would begin anew."""

    def trained(self, copy: int) -> Trained:
        """A copy as the last episode has left it."""

    def close(self) -> None:
        """Let go of all that is held outside of this process; a further episode starts anew."""


class CopiesHere:
    """All copies in this process, as the Proposer's environment.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta.env.SolverTrainingEnv`.
    """

    def __init__(self, proposer: PPO) -> None:
        self._proposer = proposer
        self._env: SolverTrainingEnv = proposer.env

    def roll_out(
        self,
        solver: TensorDictBase,
        streams: Streams,
        pause: Pause | None = None,
        begun: dict[str, Any] | None = None,
    ) -> TensorDictBase:
        """See :meth:`Copies.roll_out`."""
        if begun is not None:
            with suppress(ReplayError):
                return self._play(solver, streams, pause, begun)
        return self._play(solver, streams, pause)

    def episode(self) -> dict[str, Any] | None:
        """See :meth:`Copies.episode`."""
        return self._env.episode()

    def trained(self, copy: int) -> Trained:
        """See :meth:`Copies.trained`."""
        levels, (rollout, metrics) = self._env.last_training
        snapshot = self._env.solvers.snapshot()[[copy]]
        return Trained(snapshot, levels[[copy]], Update(rollout[[copy]], metrics))

    def close(self) -> None:
        """Nothing is held outside."""

    def _play(
        self,
        solver: TensorDictBase,
        streams: Streams,
        pause: Pause | None,
        begun: dict[str, Any] | None = None,
    ) -> TensorDictBase:
        self._env.fork(solver, streams, pause)
        if begun is not None:
            self._env.resume(begun)
        env = self._env
        return self._proposer.collect(action_generators(streams, env.batch_size[0], env.device))


def action_generators(
    streams: Streams, copies: int, device: torch.device | None
) -> list[torch.Generator]:
    """Of the Proposer's actions on each copy of a cycle."""
    return [streams.generator("proposals", copy, device=device) for copy in range(copies)]
