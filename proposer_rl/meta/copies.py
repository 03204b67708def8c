"""The K replicas of a cycle: rolled out, and one of them taken out again, wherever they are."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase

from proposer_rl.learning import PPO, Update
from proposer_rl.meta.env import SolverTrainingEnv, action_generators
from proposer_rl.streams import Streams


class Trained(NamedTuple):
    """One replica at the end of its episode.

    Attributes:
        solver: its snapshot, batch [1].
        levels: of its last update, [1, P].
        update: its last update, [1, P, T] and [1].
    """

    solver: TensorDictBase
    levels: Any
    update: Update

    def to(self, device: torch.device | str) -> Trained:
        """The same on another device."""
        rollout, metrics = self.update
        update = Update(rollout.to(device), metrics.to(device))
        return Trained(self.solver.to(device), self.levels.to(device), update)


def taken_out(env: SolverTrainingEnv, index: int) -> Trained:
    """One of an environment's Solvers after its last update."""
    own, (levels, (rollout, metrics)) = slice(index, index + 1), env.last_training
    return Trained(env.solvers.snapshot()[own], levels[own], Update(rollout[own], metrics[own]))


class Copies:
    """The replicas of the Solver, which are trained while the Proposer acts on them.

    All of them are in this process, as the Proposer's environment.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta.env.SolverTrainingEnv`.
    """

    def __init__(self, proposer: PPO) -> None:
        self._proposer = proposer
        self._env: SolverTrainingEnv = proposer.env

    def roll_out(self, solver: TensorDictBase, streams: Streams) -> TensorDictBase:
        """One episode of K replicas of a Solver, whose snapshot is given, batch [].

        Returns:
            The Proposer's rollout, [K, T], ready for
            :meth:`~proposer_rl.learning.ppo.PPO.optimise`.
        """
        self._env.fork(solver, streams)
        copies = range(self._env.batch_size[0])
        return self._proposer.collect(action_generators(streams, copies))

    def trained(self, copy: int) -> Trained:
        """One replica, by its number, as the last episode has left it."""
        return taken_out(self._env, copy)

    def close(self) -> None:
        """Let go of all that is held outside of this process; a further episode starts anew."""
