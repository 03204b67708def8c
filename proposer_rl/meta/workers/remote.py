"""What lives in a worker: the environment and the policy that a TorchRL collector is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from tensordict import TensorDict, TensorDictBase

from proposer_rl.learning.cuda_graphs import use
from proposer_rl.learning.divergence import DivergedError
from proposer_rl.learning.rollout import RolloutPolicy
from proposer_rl.meta.copies import action_generators
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.models import ActorCritic, uniform_noise
from proposer_rl.streams import Streams


class Report(NamedTuple):
    """What a worker tells of the last update of an episode, on the CPU.

    Attributes:
        steps: the gradient steps of the n copies of the share, [S, n]; nan where only one number
            is known of all copies.
        copy: snapshot, levels and rollout of the copy that was asked for, each with a first
            dimension of one; nothing from a worker that does not compute it.
    """

    steps: TensorDictBase
    copy: tuple[Any, ...]


class WorkerEnv(SolverTrainingEnv):
    """The meta-environment of a worker: it survives a Solver that diverges, to tell of it.

    An exception in a collector's process would end it, and the worker would be replaced in vain.

    Attributes:
        diverged: of this fork, what is not finite and where; None where all is well.
    """

    diverged: str | None = None

    def fork(
        self, solver: TensorDictBase, streams: Streams, pause: Callable[[], None] | None = None
    ) -> None:
        """See :meth:`SolverTrainingEnv.fork`."""
        self.diverged = None
        super().fork(solver, streams, pause)

    def report(self, copy: int, share: range) -> Report:
        """Tell of the last update, and all of one copy if it is in the share."""
        own = {
            key: entry[:, share.start : share.stop]
            if entry.ndim == 2
            else entry.new_full((len(entry), len(share)), torch.nan)
            for key, entry in self.solvers.gradient_steps.items()
        }
        steps = TensorDict(own, [len(self.solvers.gradient_steps), len(share)]).cpu()
        if copy not in share:
            return Report(steps, ())
        levels, (rollout, _) = self.last_training
        solver = self.solvers.snapshot()[[copy]].cpu().consolidate()
        return Report(steps, (solver, levels[[copy]].cpu(), rollout[[copy]].cpu()))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.diverged is None:
            try:
                return super()._step(tensordict)
            except DivergedError as error:
                self.diverged = str(error)
        # What is left of the rollout is of no use to anyone.
        self._updates = self.episode_length
        reward = torch.full_like(self._origin_return, torch.nan)
        none = torch.zeros(*self.batch_size, self.proposals.choices, dtype=torch.int64)
        state = self._state(self._origin_return, self._origin_probes, none.to(self.device))
        return state.set("reward", reward.unsqueeze(-1))


class MakeEnv(Protocol):
    """Makes a meta-environment of all K copies that computes a share of them; can be pickled."""

    def __call__(
        self, *, share: range, device: str, kind: type[SolverTrainingEnv]
    ) -> SolverTrainingEnv:
        """An environment of the class ``kind`` on a device."""


def make_worker_env(make_env: MakeEnv, share: range, device: str, threads: int) -> Any:
    """The environment of a worker, computed with as many threads as in the main process."""
    use(torch.device(device))
    torch.set_num_threads(threads)
    return make_env(share=share, device=device, kind=WorkerEnv)


class WorkerPolicy(RolloutPolicy):
    """The Proposer in a worker; :meth:`start` before every rollout.

    Args:
        agent: the Proposer on the CPU; its weights do not matter.
        horizon: steps T of a rollout.
        device: where it acts.
    """

    def __init__(self, agent: ActorCritic, horizon: int, device: str) -> None:
        super().__init__(agent.to(device))
        self.horizon = horizon

    def start(self, weights: TensorDictBase, streams: Streams, shape: torch.Size) -> None:
        """Expect a rollout.

        Args:
            weights: of the Proposer, by name.
            streams: of the cycle.
            shape: of an action of all copies, [K, ...].
        """
        (agent,) = self._agent
        for name, parameter in agent.named_parameters():
            parameter.data.copy_(weights[name])
        device = next(agent.parameters()).device
        generators = action_generators(streams, shape[0], device)
        self.begin(uniform_noise(shape, self.horizon, generators, device))
