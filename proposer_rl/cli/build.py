"""From the configuration to an experiment: nothing is written here, wrong input ends here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from typing import Any, NamedTuple

import torch

from proposer_rl.cli.config import ConfigError, Maker, RunConfig, curriculum_maker, task_maker
from proposer_rl.cli.errors import one_line
from proposer_rl.cli.loggers import make_log, require_logger
from proposer_rl.cli.outcome import run_name
from proposer_rl.curricula import Curriculum, LearnedCurriculum, TaskStudent, require
from proposer_rl.experiment import Experiment, check_headline
from proposer_rl.extras import install_command
from proposer_rl.learning import PPO
from proposer_rl.learning.cuda_graphs import recorded, use
from proposer_rl.meta.workers import WorkerSettings, shares
from proposer_rl.methods import Components, Workers, filtered
from proposer_rl.models import available_cores
from proposer_rl.runs.folder import RunFolder
from proposer_rl.runs.signals import StopSignals
from proposer_rl.runs.status import Status
from proposer_rl.settings import ArgumentError, ComputeSettings, SolverSettings
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task


class Made(NamedTuple):
    """What an experiment is made of."""

    task: Task
    learner: PPO
    curriculum: Curriculum


def parts(config: RunConfig, signals: StopSignals, status: Status | None = None) -> Made:
    """Task, Solvers and curriculum of an experiment; nothing is written yet.

    Args:
        config: the run's settings.
        signals: which may interrupt a curriculum's long work.
        status: which is told of its parts.

    Raises:
        ConfigError: if settings that are each valid do not go together.
    """
    require_logger(config.logger)
    try:
        task = make_task(config)
        with _key("solver.ppo"):
            learner = task.learner([Streams(seed, "solver") for seed in config.seeds])
        with _key("schedule"):
            check_headline(task, config.schedule)
        curriculum = _curriculum(config, task, signals, status)
        try:
            require(TaskStudent(task, learner), curriculum.needs, f"method={config.method}")
        except TypeError as error:
            raise ConfigError(f"curriculum: {one_line(error)}") from error
        return Made(task, learner, curriculum)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(one_line(error)) from error


def build(
    config: RunConfig,
    made: Made,
    folder: RunFolder,
    signals: StopSignals | None = None,
    status: Status | None = None,
) -> Experiment:
    """Put an experiment together.

    Args:
        config: the run's settings.
        made: as :func:`parts` makes it.
        folder: the run's.
        signals: which may ask the run to stop.
        status: which tells what the run is doing.
    """
    return Experiment(
        *made,
        schedule=config.schedule,
        seeds=config.seeds,
        folder=folder,
        log=make_log(config.logger, folder.path, run_name(config)),
        progress=config.compute.progress,
        signals=signals,
        status=status,
    )


@contextmanager
def _key(name: str) -> Iterator[None]:
    """Put a key of the configuration before what is said of one of its arguments."""
    try:
        yield
    except ArgumentError as error:
        raise ConfigError(f"{name}.{one_line(error)}") from error


def make_task(config: RunConfig) -> Task:
    """The task of a run, on its device and with its number of threads.

    Raises:
        ConfigError: if the device cannot be used, or settings do not make a task.
    """
    compute = config.compute
    device = _device(compute.device)
    use(device)
    if compute.threads is not None:
        torch.set_num_threads(compute.threads)
    context = ComputeContext(device, config.precision, compute.cores)
    try:
        task = task_maker(config.task)(solver=config.solver, context=context)
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"task.{one_line(error)}") from error
    return recorded(task) if compute.graphs else task


def _make_in_worker(
    maker: Maker, solver: SolverSettings, context: ComputeContext, graphs: bool, device: str
) -> Any:
    task = maker(solver=solver, context=context._replace(device=torch.device(device)))
    return recorded(task) if graphs else task


def _curriculum(
    config: RunConfig, task: Task, signals: StopSignals, status: Status | None
) -> Curriculum:
    def tell(done: int) -> None:
        if status is not None:
            status.tick("training the replicas", done)

    def on_update(done: int) -> None:
        tell(done)
        signals.check()

    components = Components(
        task, config.proposer, config.seeds, on_update, _workers(config, task, tell)
    )
    try:
        with _key("curriculum"):
            curriculum = curriculum_maker(config.curriculum)(components)
    except ConfigError:
        raise
    except (TypeError, ValueError) as error:
        raise ConfigError(f"curriculum: {one_line(error)}") from error
    if not isinstance(curriculum, Curriculum):
        kind = type(curriculum).__name__
        raise ConfigError(f"curriculum: must make a Curriculum, but makes {kind}")
    learned = isinstance(curriculum, LearnedCurriculum) and curriculum.trains_replicas
    if components.workers is not None and not learned:
        raise ConfigError(
            f"compute.collector={config.compute.collector}: this method trains no replicas "
            "that workers could have; leave compute.collector=single"
        )
    if config.proposer.advance != "train":
        _check_cycle(config)
    return filtered(curriculum, config.filter)


def _check_cycle(config: RunConfig) -> None:
    length, episode = config.schedule.cycle_length, config.proposer.meta_episode_length
    if length != episode:
        raise ConfigError(
            f"schedule.cycle_length={length} must equal proposer.meta_episode_length={episode} "
            f"where proposer.advance={config.proposer.advance}"
        )
    if config.schedule.updates % episode:
        raise ConfigError(
            f"schedule.updates={config.schedule.updates} must be a multiple of "
            f"proposer.meta_episode_length={episode} where proposer.advance="
            f"{config.proposer.advance}: a Solver that becomes a copy has all of its updates"
        )


def _workers(config: RunConfig, task: Task, tell: Callable[[int], None]) -> Workers | None:
    """Where the replicas are trained; None for this process.

    Raises:
        ConfigError: for workers that there are not, that would have nothing to do, or that cannot
            be had.
    """
    compute, copies = config.compute, config.proposer.rollouts
    if compute.collector == "single":
        for key in ("workers", "worker_devices"):
            if getattr(compute, key) is not None:
                raise ConfigError(
                    f"compute.{key}={getattr(compute, key)}: there are workers only with "
                    "compute.collector=multiprocess or ray"
                )
    if compute.collector != "ray" and compute.ray_address is not None:
        raise ConfigError(
            f"compute.ray_address={compute.ray_address}: is of use only with compute.collector=ray"
        )
    if compute.collector == "single":
        return None
    if compute.collector == "ray" and find_spec("ray") is None:
        raise ConfigError(
            f"compute.collector=ray: needs Ray; install it with: {install_command('ray')}"
        )
    on_gpus = task.device.type == "cuda"
    available = torch.cuda.device_count() if on_gpus else available_cores()
    count = compute.workers or min(copies, available)
    with _key("compute"):
        shares(copies, count)
    devices = compute.worker_devices or _devices(compute, task.device)
    if compute.collector == "multiprocess":
        devices = [str(_device(name, "worker_devices")) for name in devices]
    cores = compute.cores or max(1, available_cores() // count)
    settings = WorkerSettings(
        engine=compute.collector,
        workers=count,
        devices=devices,
        cores=cores,
        ray_address=compute.ray_address,
    )
    context = ComputeContext(precision=task.precision, cores=cores)
    make: Callable[[str], Any] = partial(
        _make_in_worker, task_maker(config.task), config.solver, context, compute.graphs
    )
    return Workers(settings, make, tell)


def _devices(compute: ComputeSettings, device: torch.device) -> list[str]:
    """All GPUs in turn where the run is on one; Ray shows a worker only those that it reserved."""
    if device.type == "cuda" and compute.collector == "multiprocess":
        return [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    return [device.type]


def _device(name: str, key: str = "device") -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        probe = torch.ones(1, device=name)
        probe.item()  # the device "meta" computes nothing
        return probe.device
    except (RuntimeError, AssertionError) as error:
        reason = one_line(error)[:120]
        raise ConfigError(
            f"compute.{key}={name!r}: must be auto, cpu or a usable one: {reason}"
        ) from error
