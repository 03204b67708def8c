"""The collectors that start the workers: processes of this machine, or Ray's on any."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Literal, NamedTuple

import torch
from torchrl.collectors import BaseCollector, MultiSyncCollector

# What a collector raises when a process of its own has died or cannot be reached any more.
LOST = (RuntimeError, EOFError, OSError, ValueError)
SECONDS_TO_CLOSE = 5.0
SECONDS_TO_ANSWER = 10.0


class WorkersError(RuntimeError):
    """The workers cannot do their work; the message is one line."""

    exit_code = 6


class WorkerSettings(NamedTuple):
    """Where the copies of the Solver are trained.

    Attributes:
        engine: ``"multiprocess"``: processes of this machine, by TorchRL's
            :class:`~torchrl.collectors.MultiSyncCollector`; ``"ray"``: actors of a Ray cluster, by
            its :class:`~torchrl.collectors.distributed.RayCollector`.
        workers: their number.
        devices: of the workers, in turn.
        cores: of a processor, for each worker.
        ray_address: of a running cluster; None to start one on this machine.
    """

    engine: Literal["multiprocess", "ray"]
    workers: int
    devices: Sequence[str]
    cores: int
    ray_address: str | None = None


class Order(NamedTuple):
    """What the workers are to be: a factory of the environment and of the policy for each.

    Attributes:
        environments, policies: factories, which can be pickled.
        frames: that each worker collects in a batch.
        threads: of torch, in each process.
    """

    environments: list[Callable[[], Any]]
    policies: list[Callable[[], Any]]
    frames: int
    threads: int


def start(chosen: WorkerSettings, order: Order) -> BaseCollector:
    """Start the workers.

    Raises:
        WorkersError: if there is no such cluster, or it is too small.
    """
    with _threads_kept(), _signals_kept(), warnings.catch_warnings():
        # TorchRL's, of a policy that it will not update: the weights come with every order.
        warnings.filterwarnings("ignore", message="The policy is not an nn.Module")
        return {"multiprocess": _multiprocess, "ray": _ray}[chosen.engine](chosen, order)


def lost(chosen: WorkerSettings) -> tuple[type[Exception], ...]:
    """What is raised where a worker is lost."""
    if chosen.engine != "ray":
        return LOST
    from ray.exceptions import RayError

    return (*LOST, RayError)


def stop(collector: BaseCollector) -> None:
    """End the workers, whatever state they are in."""
    with _threads_kept(), _signals_kept():
        with suppress(Exception):  # of a collector whose workers are gone
            collector.shutdown(timeout=SECONDS_TO_CLOSE)
        for process in getattr(collector, "procs", ()):
            with suppress(ValueError):  # closed already
                process.kill()
                process.join()


def _multiprocess(chosen: WorkerSettings, order: Order) -> BaseCollector:
    return MultiSyncCollector(
        order.environments,
        policy_factory=order.policies,
        frames_per_batch=order.frames * chosen.workers,
        reset_at_each_iter=True,
        storing_device="cpu",
        cat_results="stack",
        use_buffers=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
        # TorchRL would leave this process fewer threads, and sums over them would round otherwise.
        num_threads=order.threads,
        num_sub_threads=order.threads,
    )


def _ray(chosen: WorkerSettings, order: Order) -> BaseCollector:
    import ray
    from torchrl.collectors.distributed import RayCollector

    workers = range(chosen.workers)
    on_gpus = any(torch.device(device).type == "cuda" for device in chosen.devices)
    try:
        collector = RayCollector(
            order.environments,
            policy_factory=order.policies,
            frames_per_batch=order.frames * chosen.workers,
            total_frames=sys.maxsize,  # -1, its default, ends a synchronous collection at once
            reset_at_each_iter=True,
            storing_device="cpu",
            sync=True,
            trust_policy=True,
            # One for each: TorchRL writes a worker's policy factory into them.
            collector_kwargs=[
                {"use_buffers": False, "auto_register_policy_transforms": False} for _ in workers
            ],
            remote_configs=[_resources(chosen, on_gpus) for _ in workers],
            # The weights travel with every order. TorchRL's scheme joins all in one torch process
            # group, which a worker that replaces another cannot enter.
            weight_sync_schemes={},
            ray_init_config=_cluster(chosen),
        )
    except ConnectionError as error:  # Ray's, of an address such as auto
        raise WorkersError(
            f"compute.ray_address={chosen.ray_address}: no cluster answers there"
        ) from error
    available = ray.cluster_resources()
    needed = {"CPU": chosen.cores * chosen.workers, "GPU": float(on_gpus)}
    for name, amount in needed.items():
        if available.get(name, 0) < amount:
            stop(collector)
            raise WorkersError(
                f"compute.workers={chosen.workers}: the Ray cluster has "
                f"{available.get(name, 0):g} {name}, {amount:g} are needed"
            )
    return collector


def _resources(chosen: WorkerSettings, on_gpus: bool) -> dict[str, Any]:
    """What Ray reserves for a worker, which it places on another machine where it can."""
    visible = torch.cuda.device_count() if chosen.ray_address is None else chosen.workers
    gpus = min(1.0, visible / chosen.workers) if on_gpus else 0
    return {"num_cpus": chosen.cores, "num_gpus": gpus, "scheduling_strategy": "SPREAD"}


def _cluster(chosen: WorkerSettings) -> dict[str, Any]:
    quiet = {"log_to_driver": False, "logging_level": "error"}
    if chosen.ray_address is not None:
        _knock(chosen.ray_address)
        return {"address": chosen.ray_address, **quiet}
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster of ours tells nobody
    # As many as are asked for, or Ray would wait for processors that will never be there.
    processors = max(os.cpu_count() or 1, chosen.cores * chosen.workers)
    return {"address": "local", "num_cpus": processors, "include_dashboard": False, **quiet}


def _knock(address: str) -> None:
    """Find out at once that nobody is there: Ray would go on asking for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        return  # a name that Ray itself resolves, such as auto
    try:
        socket.create_connection((host, int(port)), SECONDS_TO_ANSWER).close()
    except (OSError, OverflowError) as error:
        raise WorkersError(
            f"compute.ray_address={address}: no cluster answers there: {error}"
        ) from error


@contextmanager
def _threads_kept() -> Iterator[None]:
    """TorchRL's collectors change the threads of this process when they start and when they end."""
    before = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Ray puts a handler of its own in the place of this process's, which saves before it ends."""
    before = {s: signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for signum, handler in before.items():
                signal.signal(signum, handler)


def collect(collector: BaseCollector) -> Any:
    """The next batch of all workers, [W, K, T]."""
    # A collector that loses a worker ends by itself.
    with _threads_kept(), warnings.catch_warnings():
        # What TorchRL's weight synchronisation would do is done with every order.
        warnings.filterwarnings("ignore", message="RayCollector iteration started before")
        return collector.next()
