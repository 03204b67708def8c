"""Builds the parts of an experiment from its configuration, or reads them from a run's folder."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict

from proposer_rl.cli.config import RunConfig, saved_config, task_maker
from proposer_rl.cli.errors import ConfigError
from proposer_rl.curricula import Curriculum, LearnedCurriculum, TaskStudent, require
from proposer_rl.experiment import Experiment, Log, check_headline
from proposer_rl.extras import require_package
from proposer_rl.learning import PPO, SolverSettings
from proposer_rl.meta.assembly import Components, Workers
from proposer_rl.meta.workers import WorkerSettings
from proposer_rl.methods import INPUT_ERRORS
from proposer_rl.methods import build as build_curriculum
from proposer_rl.models import available_cores, check_torch_defaults, use_device
from proposer_rl.runs.checkpoint import checkpoint_files, load_checkpoint, load_latest
from proposer_rl.runs.folder import RunFolder
from proposer_rl.runs.process import Status, StopSignals
from proposer_rl.settings import within
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task


class Made(NamedTuple):
    """The task, the Solvers and their curricula of an experiment."""

    task: Task
    learner: PPO
    curricula: list[Curriculum]


def parts(config: RunConfig, signals: StopSignals, status: Status | None = None) -> Made:
    """Builds the task, the Solvers and their curricula."""
    if config.logger.type != "csv":
        require_package(f"logger={config.logger.type}", config.logger.type, config.logger.type)
    task = make_task(config)
    with within("solver.ppo", ValueError):
        learner = task.learner([Streams(seed, "solver") for seed in config.seeds])
    with within("schedule"):
        check_headline(task, config.schedule)
    curricula = [_curriculum(config, task, seed, signals, status) for seed in config.seeds]
    with within("curriculum", *INPUT_ERRORS):
        require(TaskStudent(task, learner), curricula[0].needs, f"method={config.method}")
    return Made(task, learner, curricula)


def build(
    config: RunConfig,
    made: Made,
    folder: RunFolder,
    signals: StopSignals | None = None,
    status: Status | None = None,
    log: Log | None = None,
) -> Experiment:
    """Returns the experiment of the parts that :func:`parts` has built."""
    return Experiment(
        *made,
        schedule=config.schedule,
        seeds=config.seeds,
        folder=folder,
        log=log,
        progress=config.compute.progress,
        signals=signals,
        status=status,
    )


def make_task(config: RunConfig) -> Task:
    """Builds the task of a run on its device, and sets torch's number of threads."""
    compute = config.compute
    device = _device(compute.device)
    if compute.threads is not None:
        torch.set_num_threads(compute.threads)
    context = ComputeContext(
        device, config.precision, compute.cores, compute.graphs, compute.compile
    )
    check_torch_defaults()
    maker = task_maker(config.task)
    with within("task", ValueError, lead="task."):
        task: Task = _made(maker, config.solver, context, str(device))
    check_torch_defaults()  # an environment's module may have set them as it was imported
    if task.device.type != device.type:
        warnings.warn(
            f"the run is computed on {task.device.type} instead of {device.type}, where the task "
            "makes its levels",
            stacklevel=2,
        )
    return task


def _made(maker: partial[Any], solver: SolverSettings, context: ComputeContext, device: str) -> Any:
    """Builds the task on a device; workers call this, too."""
    use_device(torch.device(device))
    return maker(solver=solver, context=context._replace(device=torch.device(device)))


def _curriculum(
    config: RunConfig, task: Task, seed: int, signals: StopSignals, status: Status | None
) -> Curriculum:
    def on_update(done: int) -> None:
        if status is not None:
            status.tell("training the replicas", done)
        signals.check()

    workers = _workers(config, task)
    run = Components(task, config.proposer, seed, on_update, workers)
    asked = {"curriculum": config.curriculum, "filter": config.filter, "model": config.model}
    curriculum = build_curriculum(asked, run)
    learned = isinstance(curriculum, LearnedCurriculum) and curriculum.trains_replicas
    if workers is not None and not learned:
        raise ConfigError(
            f"compute.collector={config.compute.collector}: this method trains no replicas in "
            "workers; leave compute.collector=single"
        )
    return curriculum


def _workers(config: RunConfig, task: Task) -> Workers | None:
    """Returns the workers in which replicas are trained; None for this process."""
    compute, copies = config.compute, config.proposer.rollouts
    if compute.collector == "single":
        return None
    if compute.collector == "ray":
        require_package("compute.collector=ray", "ray", "ray")
    on_gpus = task.device.type == "cuda"
    gpus = torch.cuda.device_count()
    count = compute.workers or min(copies, gpus if on_gpus else available_cores())
    devices = [task.device.type]
    if on_gpus and compute.collector == "multiprocess":  # Ray assigns devices itself
        devices = [f"cuda:{index}" for index in range(gpus)]
    cores = compute.cores or max(1, available_cores() // count)
    settings = WorkerSettings(compute.collector, count, devices, cores, compute.ray_address)
    context = ComputeContext(
        precision=task.precision, cores=cores, graphs=compute.graphs, compile=compute.compile
    )
    make = partial(_made, task_maker(config.task), config.solver, context)
    return settings, make


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    with within("compute", RuntimeError, AssertionError, lead=f"compute.device={name}: "):
        probe = torch.ones(1, device=name)
        probe.item()  # the device "meta" computes nothing
    return probe.device


class Stage(NamedTuple):
    """A run's Solvers at a checkpoint."""

    step: int
    updates: int
    learner: PPO

    @property
    def solver(self) -> TensorDict:
        """A snapshot of the first of them, batch [1]."""
        return self.learner.snapshot()[:1]


class StoredRun(NamedTuple):
    """A run that has checkpoints."""

    folder: Path
    config: RunConfig
    task: Task
    files: list[Path]  # its checkpoints, oldest first; at least one

    def stage(self, file: Path | None = None, seeds: Sequence[int] | None = None) -> Stage:
        """Returns the Solvers of some seeds in one of the files.

        Args:
            file: None for the newest checkpoint that is intact.
            seeds: None for all.
        """
        seeds = self.config.seeds if seeds is None else seeds
        found = load_latest(self.files[-1].parent) if file is None else load_checkpoint(file)
        assert found is not None, "there is a checkpoint"
        step, state = found
        learner = self.task.learner([Streams(seed) for seed in seeds])
        every = TensorDict(state["solver"], [len(self.config.seeds)])
        with within("checkpoint", ValueError):  # of another network
            learner.restore(every[[self.config.seeds.index(seed) for seed in seeds]])
        return Stage(step, int(state["updates"]), learner)


def stored_run(path: Path) -> StoredRun:
    """Reads the settings of a run and makes its task.

    Args:
        path: the folder, or one of its checkpoints, which is then the only file.
    """
    folder, files = path.resolve(), [file for _, file in checkpoint_files(path / "checkpoints")]
    if path.is_file():
        folder, files = folder.parent.parent, [path]
    if not files:
        raise ConfigError(f"{path}: holds no checkpoints; give a run's folder or a checkpoint")
    config = saved_config(folder)
    return StoredRun(folder, config, make_task(config), files)
