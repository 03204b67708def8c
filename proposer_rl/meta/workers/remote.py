"""What lives in a worker: the environment and the policy that a TorchRL collector is made of."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase

from proposer_rl.learning import DivergedError, RolloutPolicy
from proposer_rl.meta.assembly import meta_env
from proposer_rl.meta.copies import Trained, taken_out
from proposer_rl.meta.env import SolverTrainingEnv, action_generators
from proposer_rl.meta.rewards import Reward
from proposer_rl.meta.settings import ProposerSettings
from proposer_rl.models import ActorCritic, own_state, uniform_noise, use_device
from proposer_rl.streams import Streams
from proposer_rl.task import Task


class WorkerEnv(SolverTrainingEnv):
    """The meta-environment of a worker: it survives a Solver that diverges, and reports it.

    An exception in a collector's process would end it, and the worker would be replaced in vain.

    Attributes:
        diverged: of this fork, what is not finite and where; None where all is well.
    """

    diverged: str | None = None

    def fork(self, solver: TensorDictBase, streams: Streams) -> None:
        """See :meth:`SolverTrainingEnv.fork`."""
        self.diverged = None
        super().fork(solver, streams)

    def trained(self, copy: int) -> Trained | None:
        """A replica as its last update has left it, on the CPU; None if another worker has it."""
        if copy not in self._copies:
            return None
        own = taken_out(self, copy - self._copies.start).to("cpu")
        return own._replace(solver=own.solver.consolidate())  # one thing to send, not hundreds

    @own_state()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.diverged is None:
            try:
                return super()._step(tensordict)
            except DivergedError as error:
                self.diverged = str(error)
        # What is left of the rollout is of no use to anyone.
        state = self._reset()
        self._updates = self.meta_episode_length
        ended = torch.ones_like(state["terminated"])
        state.update({"terminated": ended, "done": ended.clone()})
        return state.set("reward", torch.full_like(state["return"], torch.nan))


@own_state()
def worker_env(
    make_task: Callable[[str], Task],
    config: ProposerSettings,
    streams: Streams,
    reward: Reward,
    *,
    share: range,
    device: str,
    threads: int,
) -> SolverTrainingEnv:
    """A worker's environment, whose task is made there, on its device; threads as in the main one.

    The first arguments are as of :func:`~proposer_rl.meta.assembly.meta_env`.
    """
    use_device(torch.device(device))
    torch.set_num_threads(threads)
    return meta_env(make_task(device), config, streams, reward, share, kind=WorkerEnv)


class WorkerPolicy(RolloutPolicy):
    """The Proposer in a worker, where an action of one replica has this shape.

    It gets its weights before every rollout.
    """

    def __init__(self, agent: ActorCritic, horizon: int, shape: torch.Size, device: str) -> None:
        super().__init__(agent.to(device))
        self.horizon = horizon
        self.shape = shape

    def start(self, weights: TensorDictBase, streams: Streams, share: range) -> None:
        """Expect a rollout of these replicas."""
        (agent,) = self._agent
        for name, parameter in agent.named_parameters():
            parameter.data.copy_(weights[name])
        device = next(agent.parameters()).device
        shape = torch.Size([len(share), *self.shape])
        generators = action_generators(streams, share)
        self.begin(uniform_noise(shape, self.horizon, generators, device))
