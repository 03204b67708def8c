"""The K replicas of a cycle, rolled out wherever they are."""

from __future__ import annotations

from typing import Protocol

from tensordict import TensorDictBase

from proposer_rl.learning import PPO
from proposer_rl.meta.env import SolverTrainingEnv, action_generators
from proposer_rl.streams import Streams


class Copies(Protocol):
    """Where the replicas of the Solver are trained while the Proposer acts on them."""

    def roll_out(self, solver: TensorDictBase, streams: Streams) -> TensorDictBase:
        """One episode of K replicas of a Solver.

        Args:
            solver: a snapshot of one Solver, batch [].
            streams: of the cycle.

        Returns:
            The Proposer's rollout, [K, T], ready for
            :meth:`~proposer_rl.learning.ppo.PPO.optimise`.
        """

    def close(self) -> None:
        """Let go of all that is held outside of this process; a further episode starts anew."""


class CopiesHere:
    """All replicas in this process, as the Proposer's environment.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta.env.SolverTrainingEnv`.
    """

    def __init__(self, proposer: PPO) -> None:
        self._proposer = proposer
        self._env: SolverTrainingEnv = proposer.env

    def roll_out(self, solver: TensorDictBase, streams: Streams) -> TensorDictBase:
        """See :meth:`Copies.roll_out`."""
        env = self._env
        env.fork(solver, streams)
        copies = range(env.batch_size[0])
        return self._proposer.collect(action_generators(streams, copies))

    def close(self) -> None:
        """Nothing is held outside."""
