"""The main process's side: orders to the workers, and what comes back put together."""

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

from proposer_rl.learning import PPO, DivergedError
from proposer_rl.meta.copies import Copies, Trained
from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.meta.workers.engines import (
    WorkersError,
    WorkerSettings,
    lost,
    quiet,
    start,
    stop,
)
from proposer_rl.meta.workers.remote import WorkerPolicy
from proposer_rl.settings import ArgumentError
from proposer_rl.streams import Streams

ATTEMPTS = 3


class CopiesInWorkers(Copies):
    """Copies that are trained by workers, each of which has a share of them.

    Where a worker is lost, all are started anew and the episode is repeated, with the same numbers.

    Args:
        proposer: PPO whose environment is a :class:`~proposer_rl.meta.env.SolverTrainingEnv` of all
            replicas; it is used for all but the replicas' training.
        make_env: makes a worker's environment of a ``share`` on a ``device`` with so many
            ``threads``; can be pickled.
        settings: how many workers there are, and where.

    Raises:
        ValueError: for more workers than replicas.
    """

    def __init__(
        self,
        proposer: PPO,
        make_env: Callable[..., SolverTrainingEnv],
        settings: WorkerSettings,
    ) -> None:
        super().__init__(proposer)
        self._make_env = make_env
        self._settings = settings
        self._shares = shares(self._env.batch_size[0], settings.workers)
        # Of each replica its place, [K], among those of all workers: in the first that has it.
        every = [copy for share in self._shares for copy in share]
        self._first = [every.index(copy) for copy in range(self._env.batch_size[0])]
        self._collector: BaseCollector | None = None
        self._losses = 0

    def roll_out(self, solver: TensorDictBase, streams: Streams) -> TensorDictBase:
        """See :meth:`~proposer_rl.meta.copies.Copies.roll_out`.

        Raises:
            DivergedError: if a replica diverges, as in one process.
            WorkersError: if workers are lost again and again.
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
                # A worker's error comes with its traceback before.
                reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
                if attempt == ATTEMPTS:
                    raise WorkersError(
                        f"workers={len(self._shares)}: were lost {ATTEMPTS} times in one cycle, "
                        f"last: {reason}; the same command goes on from the last checkpoint"
                    ) from error
                # It may have been the signal that ends this run, too.
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

    def trained(self, copy: int) -> Trained:
        """See :meth:`~proposer_rl.meta.copies.Copies.trained`."""
        assert self._collector is not None, "there has been no episode"
        orders = [(copy,)] * len(self._shares)
        results: list[Trained | None] = self._collector.map_fn("env.trained", orders)
        return next(filter(None, results)).to(self._env.device)

    def close(self) -> None:
        """End the workers; the next episode starts others."""
        collector, self._collector = self._collector, None
        if collector is not None:
            stop(collector)

    def _roll_out(
        self, solver: TensorDictBase, streams: Streams
    ) -> tuple[Any, Sequence[str | None]]:
        """The batch of all workers, [W, k, T], and what diverged in each."""
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
        """Workers with an environment and a policy each."""
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


def shares(copies: int, workers: int) -> list[range]:
    """The numbers of K replicas in as many ranges as there are workers, all of the same length.

    Where K is no multiple of the workers, the last ranges overlap: what one process has to do
    takes no longer for it, and TorchRL's collectors want batches of one shape.

    Raises:
        ArgumentError: for more workers than replicas, or none.
    """
    if not 1 <= workers <= copies:
        raise ArgumentError(
            f"workers={workers}: must be at least 1 and at most {copies}, the replicas that they "
            "share"
        )
    each = -(-copies // workers)
    starts = [min(worker * each, copies - each) for worker in range(workers)]
    return [range(start, start + each) for start in starts]
