"""Trains the K replicas of a cycle, in this process or in workers with TorchRL's collectors.

A worker, on this machine or another, holds and trains a share of the replicas. Every random number
belongs to the number of a replica, so results are the same wherever they are computed, up to
rounding.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from itertools import cycle
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import BaseCollector

from proposer_rl.learning import PPO, DivergedError, RolloutPolicy
from proposer_rl.meta.assembly import ProposerSettings, meta_env
from proposer_rl.meta.env import SolverTrainingEnv, action_generators
from proposer_rl.meta.rewards import Reward
from proposer_rl.meta.workers import WorkersError, WorkerSettings, lost, quiet, start, stop
from proposer_rl.models import ActorCritic, uniform_noise, use_device
from proposer_rl.streams import Streams
from proposer_rl.task import Task


class Replicas:
    """Trains K replicas of the Solver in this process while the Proposer acts on them.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta.env.SolverTrainingEnv`.
    """

    def __init__(self, proposer: PPO) -> None:
        self._proposer = proposer
        self._env: SolverTrainingEnv = proposer.env

    def roll_out(self, solver: TensorDictBase, streams: Streams) -> TensorDictBase:
        """Trains K replicas of a Solver for one episode.

        Args:
            solver: a snapshot of it, batch [].
            streams: of the cycle.

        Returns:
            The Proposer's rollout, [K, T], complete for
            :meth:`~proposer_rl.learning.ppo.PPO.optimise`.
        """
        self._env.fork(solver, streams)
        replicas = range(self._env.batch_size[0])
        return self._proposer.collect(action_generators(streams, replicas))

    def close(self) -> None:
        """Ends the processes that were started; the next episode starts new ones."""


ATTEMPTS = 3


class ReplicasInWorkers(Replicas):
    """Trains the replicas in worker processes, each of which has a share of them.

    If a worker is lost, all are restarted and the episode is repeated, with the same numbers.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta.env.SolverTrainingEnv` of all
            replicas; it does everything except train the replicas.
        make_env: makes a worker's environment from its ``share`` of the replicas, ``device`` and
            number of ``threads``, such as :func:`worker_env`; can be pickled.
        settings: how many workers there are, and where.
    """

    def __init__(
        self, proposer: PPO, make_env: Callable[..., SolverTrainingEnv], settings: WorkerSettings
    ) -> None:
        super().__init__(proposer)
        self._make_env = make_env
        self._settings = settings
        self._shares = shares(self._env.batch_size[0], settings.workers)
        # The place of each replica, [K], among those of all workers: in the first that has it.
        every = [replica for share in self._shares for replica in share]
        self._first = [every.index(replica) for replica in range(self._env.batch_size[0])]
        self._collector: BaseCollector | None = None
        self._losses = 0

    def roll_out(self, solver: TensorDictBase, streams: Streams) -> TensorDictBase:
        """Trains K replicas of a Solver for one episode; see :meth:`Replicas.roll_out`.

        Raises:
            DivergedError: if a replica diverges, as in one process.
            WorkersError: if workers are lost several times.
        """
        self._env.view.draw_levels(streams)
        for attempt in range(1, ATTEMPTS + 1):
            try:
                rollout, diverged = self._roll_out(solver, streams)
                break
            except WorkersError:
                raise
            except lost(self._settings) as error:
                self._losses += 1
                self.close()
                # The traceback of a worker precedes its error.
                reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
                if attempt == ATTEMPTS:
                    raise WorkersError(
                        f"workers={len(self._shares)}: were lost {ATTEMPTS} times in one cycle, "
                        f"last: {reason}; the same command resumes from the last checkpoint"
                    ) from error
                # The loss may be due to a signal that ends this run, too.
                self._env.on_update(0)
                warnings.warn(
                    f"a worker was lost ({reason}); it is replaced and the episode repeated",
                    RuntimeWarning,
                    stacklevel=2,
                )
        for message in filter(None, diverged):
            raise DivergedError(message)
        rollout = rollout.flatten(0, 1)[self._first]  # [K, T], each from the first that has it
        rollout = rollout.exclude("collector").to(self._env.device)
        rollout.names = [None, "time"]
        return self._proposer.complete(rollout)

    def close(self) -> None:
        """Ends the workers; the next episode starts new ones."""
        collector, self._collector = self._collector, None
        if collector is not None:
            stop(collector)

    def _roll_out(
        self, solver: TensorDictBase, streams: Streams
    ) -> tuple[Any, Sequence[str | None]]:
        """Returns the rollouts of all W workers, [W, k, T], and what diverged in each."""
        collector = self._collector
        if collector is None:
            collector = self._collector = self._start()
        # One block of memory each: across processes, every tensor costs a file descriptor.
        origin = solver.cpu().consolidate()
        named = self._proposer.agent.named_parameters()
        weights = TensorDict({name: p.detach().cpu() for name, p in named}).consolidate()
        collector.map_fn("env.fork", [(origin, streams)] * len(self._shares))
        collector.map_fn("policy.start", [(weights, streams, share) for share in self._shares])
        with quiet():
            rollouts = collector.next()
        return rollouts, collector.get_distant_attr("env.diverged")

    def _start(self) -> BaseCollector:
        """Starts workers, each with an environment and a policy."""
        horizon, threads = self._proposer.settings.horizon, torch.get_num_threads()
        agent = deepcopy(self._proposer.agent).cpu()
        shape = self._env.full_action_spec[agent.action_key].shape[1:]
        placed = list(zip(self._shares, cycle(self._settings.devices), strict=False))
        return start(
            self._settings,
            [
                partial(self._make_env, share=share, device=device, threads=threads)
                for share, device in placed
            ],
            [partial(WorkerPolicy, agent, horizon, shape, device) for _, device in placed],
            frames=len(self._shares[0]) * horizon,
            check=partial(self._env.on_update, 0),
            patient=self._losses > 0,
        )


class WorkerEnv(SolverTrainingEnv):
    """The meta-environment in a worker: reports a Solver that diverges instead of raising.

    An exception would end the collector's process, and replacing the worker would not help.

    Attributes:
        diverged: the message of what was not finite since the last fork, and where; None if all is
            well.
    """

    diverged: str | None = None

    def fork(self, solver: TensorDictBase, streams: Streams) -> None:
        """Starts the next episodes from one Solver; see :meth:`SolverTrainingEnv.fork`."""
        self.diverged = None
        super().fork(solver, streams)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.diverged is None:
            try:
                return super()._step(tensordict)
            except DivergedError as error:
                self.diverged = str(error)
        # The rest of the rollout is not used.
        state = self._reset()
        self._updates = self.meta_episode_length
        ended = torch.ones_like(state["terminated"])
        state.update({"terminated": ended, "done": ended.clone()})
        return state.set("reward", torch.full_like(state["return"], torch.nan))


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
    """Makes the environment of a worker, inside its process.

    Args:
        make_task: makes the task on a device.
        config: the Proposer's settings.
        streams: of the replicas' first weights.
        reward: of an update.
        share: the numbers of the replicas that train here.
        device: where the worker computes.
        threads: of one operation, as many as in the main process.
    """
    use_device(torch.device(device))
    torch.set_num_threads(threads)
    return meta_env(make_task(device), config, streams, reward, share, kind=WorkerEnv)


class WorkerPolicy(RolloutPolicy):
    """The Proposer in a worker, which gets its weights before every rollout.

    Args:
        agent: with any weights.
        horizon: steps T of a rollout.
        shape: of an action for one replica.
        device: where it computes.
    """

    def __init__(self, agent: ActorCritic, horizon: int, shape: torch.Size, device: str) -> None:
        super().__init__(agent.to(device))
        self.horizon = horizon
        self.shape = shape

    def start(self, weights: TensorDictBase, streams: Streams, share: range) -> None:
        """Prepares a rollout with these weights on the replicas numbered ``share``."""
        (agent,) = self._agent
        for name, parameter in agent.named_parameters():
            parameter.data.copy_(weights[name])
        device = next(agent.parameters()).device
        shape = torch.Size([len(share), *self.shape])
        generators = action_generators(streams, share)
        self.begin(uniform_noise(shape, self.horizon, generators, device))


def shares(replicas: int, workers: int) -> list[range]:
    """Splits K replicas into ranges of equal length, one for each worker.

    If K is not a multiple of the workers, the last ranges overlap, because TorchRL's collectors
    need batches of one shape. This takes no longer.
    """
    each = -(-replicas // workers)
    starts = [min(worker * each, replicas - each) for worker in range(workers)]
    return [range(start, start + each) for start in starts]
