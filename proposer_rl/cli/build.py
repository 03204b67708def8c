"""From the configuration to an experiment: nothing is written here, wrong input ends here."""

from __future__ import annotations

import sys

import torch
from hydra.errors import HydraException
from hydra.utils import instantiate
from tqdm import tqdm

from proposer_rl.cli.config import ConfigError, RunConfig
from proposer_rl.cli.errors import one_line
from proposer_rl.cli.loggers import make_log, require_logger
from proposer_rl.cli.outcome import run_name
from proposer_rl.cli.workers import workers
from proposer_rl.curricula import Curriculum
from proposer_rl.experiment import Experiment
from proposer_rl.learning.cuda_graphs import use
from proposer_rl.learning.ppo import PPO
from proposer_rl.mazes.task import MazeTask, faster_precision
from proposer_rl.methods import Parts
from proposer_rl.runs.folder import RunFolder
from proposer_rl.runs.signals import StopSignals
from proposer_rl.streams import Streams


def parts(config: RunConfig) -> tuple[MazeTask, PPO, Curriculum]:
    """Task, Solver and curriculum of an experiment; nothing is written yet.

    Raises:
        ConfigError: if settings that are each valid do not go together.
    """
    require_logger(config.logger)
    try:
        task = make_task(config)
        solver = task.solvers([Streams(seed, "solver") for seed in config.seeds])
        return task, solver, _curriculum(config, task)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "allocate" not in str(error):
            raise
        raise ConfigError(f"the run does not fit in memory: {one_line(error)}") from error


def build(
    config: RunConfig,
    task: MazeTask,
    solver: PPO,
    curriculum: Curriculum,
    folder: RunFolder,
    signals: StopSignals | None = None,
    scope: tuple[str | int, ...] = (),
) -> Experiment:
    """Put an experiment together.

    Args:
        config: the run's settings.
        task: as :func:`parts` makes it.
        solver: as :func:`parts` makes it.
        curriculum: as :func:`parts` makes it.
        folder: the run's.
        signals: which may ask the run to stop.
        scope: of its random draws; empty, or the lifetime.
    """
    return Experiment(
        solver,
        curriculum,
        schedule=config.schedule,
        seeds=config.seeds,
        folder=folder,
        evaluate=task.measure,
        statistics=task.statistics,
        records=task.records,
        log=make_log(config.logger, folder.path, run_name(config)),
        progress=config.progress,
        signals=signals,
        scope=scope,
    )


def make_task(config: RunConfig) -> MazeTask:
    """The task of a run, on its device and with its number of threads.

    Raises:
        ConfigError: if the device cannot be used.
        ValueError: if settings that are each valid do not make a task.
    """
    device = _device(config.device)
    use(device)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    automatic = config.precision == "auto"
    return MazeTask(
        maze=config.maze,
        distributions=config.distributions,
        target=config.target,
        space=config.space,
        solver=config.solver,
        evaluation=config.evaluation,
        device=device,
        precision=(
            faster_precision(config.solver.channels, device) if automatic else config.precision
        ),
        cores=config.cores,
        graphs=config.graphs,
    )


class EpisodeBar:
    """A progress bar for the steps of a meta-episode, redrawn for every episode.

    Args:
        steps: of an episode.
        enabled: whether to draw it; it is drawn on a terminal only.
    """

    def __init__(self, steps: int, enabled: bool) -> None:
        self._steps = steps
        self._enabled = enabled and sys.stderr.isatty()
        self._bar: tqdm | None = None

    def __call__(self) -> None:
        """Count one step."""
        if not self._enabled:
            return
        if self._bar is None:
            self._bar = tqdm(
                total=self._steps,
                desc="  rollouts of the copies",
                leave=False,
                position=1,
                dynamic_ncols=True,
            )
        self._bar.update()
        if self._bar.n >= self._steps:
            self._bar.close()
            self._bar = None


def _curriculum(config: RunConfig, task: MazeTask) -> Curriculum:
    bar = EpisodeBar(config.proposer.lookahead, config.progress)
    elsewhere = workers(config, task.device, _device)
    parts = Parts(task, config.proposer, config.seeds[0], bar, elsewhere)
    try:
        factory = instantiate(config.curriculum, _partial_=True)
        curriculum = factory(parts)
    except (TypeError, ValueError, HydraException) as error:
        raise ConfigError(f"curriculum: {one_line(error)}") from error
    if not isinstance(curriculum, Curriculum):
        kind = type(curriculum).__name__
        raise ConfigError(f"curriculum: must make a Curriculum, but makes {kind}")
    if elsewhere is not None and not curriculum.uses_workers:
        raise ConfigError(
            f"collector={config.collector}: {config.method} trains no copies of the Solver, so "
            "there is nothing for workers to do; leave collector=single"
        )
    most = curriculum.most_solvers
    if most is not None and len(config.seeds) > most:
        raise ConfigError(
            f"seeds={config.seeds}: {config.method} trains at most {most} at a time; "
            "give one run for each, as in -m seed=0,1,2"
        )
    return curriculum


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        probe = torch.ones(1, device=name)
        probe.item()  # the device "meta" computes nothing
        return probe.device
    except (RuntimeError, AssertionError) as error:
        reason = one_line(error)[:120]
        raise ConfigError(
            f"device={name!r}: must be auto, cpu or a usable one: {reason}"
        ) from error
