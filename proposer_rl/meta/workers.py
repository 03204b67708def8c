"""Starts and ends workers with TorchRL's collectors: local processes, or Ray actors."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from typing import Any, Literal, NamedTuple

import torch
from torchrl.collectors import BaseCollector, MultiSyncCollector

# Exceptions of a collector whose process has died or cannot be reached any more.
LOST = (RuntimeError, EOFError, OSError, ValueError)
SECONDS_TO_CLOSE = 5.0
SECONDS_TO_ANSWER = 60.0  # of a cluster
SECONDS_TO_START = 300.0  # of workers, while others may use a cluster's processors
SECONDS_TO_SAY = 20.0  # between two warnings while waiting
SECONDS_TO_POLL = 0.5  # between two checks while waiting


class WorkersError(RuntimeError):
    """The workers cannot do their work; the message is one line ``argument=value: why``."""

    exit_code = 6


class WorkerSettings(NamedTuple):
    """Settings of the worker processes in which replicas of the Solver are trained.

    Attributes:
        engine: ``"multiprocess"``: processes of this machine, by TorchRL's
            :class:`~torchrl.collectors.MultiSyncCollector`; ``"ray"``: actors of a Ray cluster, by
            its :class:`~torchrl.collectors.distributed.RayCollector`.
        workers: number of workers.
        devices: names of torch devices, assigned to the workers in turn.
        cores: number of processor cores for each worker.
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
    check: Callable[[], None],
    patient: bool,
) -> BaseCollector:
    """Starts the workers, and returns the collector that controls them.

    Args:
        settings: how many workers there are, and where.
        environments: factories of environments, one for each worker; can be pickled.
        policies: factories of policies, likewise.
        frames: number of frames that a worker collects in a batch.
        check: called repeatedly while waiting for workers; may raise.
        patient: whether to wait for missing machines, as after a loss.

    Raises:
        WorkersError: if there is no such cluster, it is too small, or its workers do not come up.
    """
    common: dict[str, Any] = {
        "policy_factory": policies,
        "frames_per_batch": frames * settings.workers,
        "reset_at_each_iter": True,
        "storing_device": "cpu",
        "trust_policy": True,
    }
    unused = {"use_buffers": False, "auto_register_policy_transforms": False}
    threads = torch.get_num_threads()
    with quiet():
        if settings.engine == "multiprocess":
            return MultiSyncCollector(
                environments,
                cat_results="stack",
                # TorchRL would leave this process fewer threads, which would change rounding.
                num_threads=threads,
                num_sub_threads=threads,
                **unused,
                **common,
            )
        from torchrl.collectors.distributed import RayCollector

        share = _cluster_share(settings, check, patient)
        collector = RayCollector(
            environments,
            total_frames=sys.maxsize,  # -1, its default, ends a synchronous collection at once
            sync=True,
            # A copy for each: TorchRL writes a worker's policy factory into them.
            collector_kwargs=[unused.copy() for _ in environments],
            remote_configs=[share.copy() for _ in environments],
            # The weights travel with every order. TorchRL's scheme joins all in one torch process
            # group, which a worker that replaces another cannot enter.
            weight_sync_schemes={},
            **common,
        )
        try:
            _wait_for_all(collector, settings, check)
        except BaseException:
            stop(collector)
            raise
        return collector


def lost(settings: WorkerSettings) -> tuple[type[Exception], ...]:
    """Returns the exceptions by which a collector reports a lost worker."""
    if settings.engine != "ray":
        return LOST
    from ray.exceptions import RayError

    return (*LOST, RayError)


def stop(collector: BaseCollector) -> None:
    """Ends the workers in any state, and for Ray's the connection to the cluster."""
    with quiet(), suppress(Exception):  # of a collector whose workers are gone
        collector.shutdown(timeout=SECONDS_TO_CLOSE)
    if not isinstance(collector, MultiSyncCollector):
        sys.modules["ray"].shutdown()
        return
    for process in collector.procs:
        with suppress(ValueError):  # closed already
            process.kill()
            process.join()


@contextmanager
def quiet() -> Iterator[None]:
    """Restores the number of threads, which TorchRL's collectors change, and hides two warnings.

    Both say that a worker's policy gets no weights, which here come with every order.
    """
    threads = torch.get_num_threads()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The policy is not an nn.Module")
            warnings.filterwarnings("ignore", message="RayCollector iteration started before")
            yield
    finally:
        torch.set_num_threads(threads)


def _cluster_share(
    settings: WorkerSettings, check: Callable[[], None], patient: bool
) -> dict[str, Any]:
    """Connects to the cluster, or starts one; returns the share that a worker reserves.

    Raises:
        WorkersError: if it does not answer, or does not have as much.
    """
    import ray

    workers, cores, address = settings.workers, settings.cores, settings.ray_address
    cluster: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address is not None:
        cluster["address"] = address
    else:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no usage reports
        # As many as the workers need, or Ray would wait for processors that do not exist.
        processors = max(os.cpu_count() or 1, cores * workers)
        cluster |= {"address": "local", "num_cpus": processors, "include_dashboard": False}
    try:
        _knock(address)
        _connect(cluster, check)
    except (OSError, RuntimeError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise WorkersError(f"ray_address={address}: no cluster answers there: {reason}") from error
    on_gpus = any(torch.device(device).type == "cuda" for device in settings.devices)
    visible = torch.cuda.device_count() if address is None else workers
    share = {"num_cpus": cores, "num_gpus": min(1.0, visible / workers) if on_gpus else 0}
    try:
        _wait(lambda: _short_of(share, workers), workers, SECONDS_TO_START * patient, check)
    except BaseException:
        ray.shutdown()
        raise
    return {**share, "scheduling_strategy": "SPREAD"}  # on several machines if possible


def _short_of(share: dict[str, Any], workers: int) -> str | None:
    """Returns why the cluster has no room for the workers; None if it has."""
    import ray

    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    asked = {"CPU": share["num_cpus"], "GPU": share["num_gpus"]}
    asked = {name: amount for name, amount in asked.items() if amount}
    places = sum(
        int(min(node.get(name, 0) / amount + 1e-6 for name, amount in asked.items()))
        for node in nodes
    )
    if places >= workers:
        return None
    have = " and ".join(f"{sum(n.get(name, 0) for n in nodes):g} {name}" for name in asked)
    each = " and ".join(f"{amount:g} {name}" for name, amount in asked.items())
    return (
        f"the Ray cluster has {have} on {len(nodes)} machines, each worker needs {each} of one: "
        f"there is room for {places}"
    )


def _wait_for_all(collector: Any, settings: WorkerSettings, check: Callable[[], None]) -> None:
    """Waits until every worker has started."""
    import ray

    workers = settings.workers
    begun = [one.get_distant_attr.remote("worker_idx") for one in collector.remote_collectors]

    def missing() -> str | None:
        ready, waiting = ray.wait(begun, num_returns=workers, timeout=SECONDS_TO_POLL)
        ray.get(ready)  # raises the error of a worker that failed to start
        free = ray.available_resources().get("CPU", 0)
        if not waiting:
            return None
        return f"{len(ready)} have begun, {free:g} CPU of the Ray cluster are free"

    _wait(missing, workers, SECONDS_TO_START, check)


def _wait(
    reason: Callable[[], str | None], workers: int, limit: float, check: Callable[[], None]
) -> None:
    """Waits until a function returns no reason to wait, and warns of the reason now and then.

    Raises:
        WorkersError: with the reason, if there still is one after ``limit`` seconds.
    """
    began = said = time.monotonic()
    while (why := reason()) is not None:
        now = time.monotonic()
        if now - began >= limit:
            raise WorkersError(f"workers={workers}: {why}" + f", after {limit:g} s" * bool(limit))
        if now - said >= SECONDS_TO_SAY:
            said = now
            warnings.warn(f"workers={workers} are waited for: {why}", RuntimeWarning, stacklevel=2)
        check()
        time.sleep(SECONDS_TO_POLL)


def _connect(cluster: dict[str, Any], check: Callable[[], None]) -> None:
    """Connects to a Ray cluster in a thread that lives as long as the connection.

    In the main thread Ray would replace the signal handlers that save before the process ends, and
    would block for minutes while it looks for a cluster. At Ray's request, Linux ends the processes
    of a local cluster with the thread that started them, so this thread must stay alive.

    Raises:
        TimeoutError: if Ray does not answer in time.
    """
    import ray

    came: Future[None] = Future()

    def live() -> None:
        try:
            ray.init(**cluster, ignore_reinit_error=True)
            came.set_result(None)
        except BaseException as error:
            came.set_exception(error)
        while ray.is_initialized():
            time.sleep(SECONDS_TO_POLL)

    threading.Thread(target=live, daemon=True).start()
    until = time.monotonic() + SECONDS_TO_ANSWER
    while True:
        with suppress(TimeoutError):
            came.result(timeout=SECONDS_TO_POLL)
            return
        check()
        if time.monotonic() > until:
            raise TimeoutError(f"none that this machine is part of in {SECONDS_TO_ANSWER:.0f} s")


def _knock(address: str | None) -> None:
    """Raises an OSError at once if nothing answers at the address of a cluster."""
    host, _, port = (address or "").rpartition(":")
    if host and port.isdigit():  # no name that Ray itself resolves, such as auto
        socket.create_connection((host, int(port)), SECONDS_TO_CLOSE).close()
