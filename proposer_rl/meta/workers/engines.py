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
    """Where the replicas of the Solver are trained.

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


def start(
    settings: WorkerSettings,
    environments: list[Callable[[], Any]],
    policies: list[Callable[[], Any]],
    frames: int,
    threads: int,
) -> BaseCollector:
    """Start the workers.

    Args:
        settings: where and how many they are.
        environments: a factory for each worker, which can be pickled.
        policies: the same.
        frames: that each worker collects in a batch.
        threads: of torch, in each process.

    Raises:
        WorkersError: if there is no such cluster, or it is too small.
    """
    common = {
        "policy_factory": policies,
        "frames_per_batch": frames * settings.workers,
        "reset_at_each_iter": True,
        "storing_device": "cpu",
        "trust_policy": True,
    }
    unused = {"use_buffers": False, "auto_register_policy_transforms": False}
    with _kept(), warnings.catch_warnings():
        # TorchRL's, of a policy that it will not update: the weights come with every order.
        warnings.filterwarnings("ignore", message="The policy is not an nn.Module")
        if settings.engine == "ray":
            return _ray(settings, environments, unused, common)
        return MultiSyncCollector(
            environments,
            cat_results="stack",
            # TorchRL would leave this process fewer threads, and its sums would round otherwise.
            num_threads=threads,
            num_sub_threads=threads,
            **unused,
            **common,
        )


def lost(settings: WorkerSettings) -> tuple[type[Exception], ...]:
    """What is raised where a worker is lost."""
    if settings.engine != "ray":
        return LOST
    from ray.exceptions import RayError

    return (*LOST, RayError)


def stop(collector: BaseCollector) -> None:
    """End the workers, whatever state they are in, and with Ray's the connection to its cluster."""
    with _kept():
        with suppress(Exception):  # of a collector whose workers are gone
            collector.shutdown(timeout=SECONDS_TO_CLOSE)
        if not isinstance(collector, MultiSyncCollector):
            sys.modules["ray"].shutdown()
            return
        for process in collector.procs:
            with suppress(ValueError):  # closed already
                process.kill()
                process.join()


def collect(collector: BaseCollector) -> Any:
    """The next batch of all workers, [W, K, T]."""
    # A collector that loses a worker ends by itself.
    with _kept(), warnings.catch_warnings():
        # What TorchRL's weight synchronisation would do is done with every order.
        warnings.filterwarnings("ignore", message="RayCollector iteration started before")
        return collector.next()


def _ray(
    settings: WorkerSettings,
    environments: list[Callable[[], Any]],
    unused: dict[str, Any],
    common: dict[str, Any],
) -> BaseCollector:
    import ray
    from torchrl.collectors.distributed import RayCollector

    workers, address = settings.workers, settings.ray_address
    on_gpus = any(torch.device(device).type == "cuda" for device in settings.devices)
    visible = torch.cuda.device_count() if address is None else workers
    share = {  # which Ray reserves for a worker; it is placed on another machine where it can be
        "num_cpus": settings.cores,
        "num_gpus": min(1.0, visible / workers) if on_gpus else 0,
        "scheduling_strategy": "SPREAD",
    }
    cluster: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address is not None:
        _knock(address)
        cluster["address"] = address
    else:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # our own cluster reports to nobody
        # As many as are asked for, or Ray would wait for processors that will never be there.
        processors = max(os.cpu_count() or 1, settings.cores * workers)
        cluster |= {"address": "local", "num_cpus": processors, "include_dashboard": False}
    try:
        ray.init(**cluster, ignore_reinit_error=True)
    except ConnectionError as error:  # Ray's, of an address such as auto
        raise WorkersError(f"compute.ray_address={address}: no cluster answers there") from error
    # Before the collector, which would wait for ever for what is not there.
    available = ray.cluster_resources()
    for name, amount in {"CPU": settings.cores * workers, "GPU": float(on_gpus)}.items():
        if available.get(name, 0) < amount:
            ray.shutdown()
            raise WorkersError(
                f"compute.workers={workers}: the Ray cluster has "
                f"{available.get(name, 0):g} {name}, {amount:g} are needed"
            )
    return RayCollector(
        environments,
        total_frames=sys.maxsize,  # -1, its default, ends a synchronous collection at once
        sync=True,
        # One for each: TorchRL writes a worker's policy factory into them.
        collector_kwargs=[unused.copy() for _ in range(workers)],
        remote_configs=[share.copy() for _ in range(workers)],
        # The weights travel with every order. TorchRL's scheme joins all in one torch process
        # group, which a worker that replaces another cannot enter.
        weight_sync_schemes={},
        **common,
    )


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
def _kept() -> Iterator[None]:
    """Puts back what the collectors change in this process.

    TorchRL's change its threads when they start and when they end; Ray puts handlers of its own in
    the place of those that save before the process ends.
    """
    threads = torch.get_num_threads()
    handlers = {s: signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        if threading.current_thread() is threading.main_thread():
            for signum, handler in handlers.items():
                signal.signal(signum, handler)
