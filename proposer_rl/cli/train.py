"""``bin/train`` and ``proposer-train``: run one experiment, or with ``-m`` several."""

from __future__ import annotations

import json
import math
import os
import platform
import shlex
import sys
from importlib.metadata import version
from pathlib import Path
from signal import SIGINT
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.console import Console
from tqdm import tqdm

from proposer_rl.capture import use
from proposer_rl.checkpoint import CheckpointError, load_latest
from proposer_rl.cli.config import CONFIG_FOLDER, ConfigError, RunConfig, check_order, read_config
from proposer_rl.cli.errors import FORESEEN, SIGNALLED, exit_code, one_line, refuse
from proposer_rl.cli.loggers import make_log, require_logger
from proposer_rl.cli.same_run import check_same_run
from proposer_rl.cli.sweep import forget_failure, record_failure
from proposer_rl.cli.workers import workers
from proposer_rl.curricula import Curriculum
from proposer_rl.experiment import Experiment
from proposer_rl.finite import DivergedError
from proposer_rl.lock import locked
from proposer_rl.machine import processor
from proposer_rl.methods import Parts
from proposer_rl.ppo import PPO
from proposer_rl.report.levels import draw_run
from proposer_rl.report.progress import read_progress
from proposer_rl.report.terminal import screen
from proposer_rl.run_folder import RunFolder
from proposer_rl.signals import Interrupted, StopSignals
from proposer_rl.streams import Streams
from proposer_rl.task import MazeTask, faster_precision


def main() -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    # Hydra then lets its errors through, so that they can be told in one line.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        _refuse_pickles(sys.argv)
        _main()
    except FORESEEN as error:
        refuse(error)
    except ValueError as error:
        if HydraConfig.initialized():
            raise
        refuse(ConfigError(str(error)))  # Hydra's, of an override such as +method=3
    except KeyboardInterrupt:
        sys.exit(SIGNALLED + SIGINT)


@hydra.main(version_base="1.3", config_path=str(CONFIG_FOLDER), config_name="train")
def _main(hydra_config: DictConfig) -> float:
    path = Path(HydraConfig.get().runtime.output_dir)
    try:
        forget_failure(path)
        check_order(HydraConfig.get().overrides.task)
        config = read_config(hydra_config)
        made = parts(config)  # whatever is wrong with the input is found here
        with locked(path), StopSignals() as signals:
            try:
                return live(config, *made, path, signals)
            finally:
                made[2].close()
    except Exception as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return record_failure(path, error, one_line(error), exit_code(error))
        if isinstance(error, FORESEEN):
            refuse(error)
        raise


def _refuse_pickles(arguments: list[str]) -> None:
    """Hydra's --experimental-rerun reads a pickle, which can run whatever it likes."""
    if any(argument.startswith("--experimental-rerun") for argument in arguments):
        raise ConfigError("--experimental-rerun: not supported; give the run's own arguments again")


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


def live(
    config: RunConfig,
    task: MazeTask,
    solver: PPO,
    curriculum: Curriculum,
    path: Path,
    signals: StopSignals,
) -> float:
    """Run all lifetimes: one Solver after another, on a curriculum that goes on learning.

    Args:
        config: the run's settings.
        task: as :func:`parts` makes it.
        solver: as :func:`parts` makes it; that of the first lifetime.
        curriculum: as :func:`parts` makes it.
        path: the run's folder, which has one for each lifetime if there are several.
        signals: which may ask the run to stop.

    Returns:
        The headline measurement at the end of the last lifetime.
    """
    value = math.nan
    before: RunFolder | None = None
    for lifetime in range(config.lifetimes):
        folder = RunFolder(path / f"lifetime_{lifetime}" if config.lifetimes > 1 else path)
        # What `auto` has become, so that a run does not go on in another precision elsewhere.
        check_same_run(folder, config.model_copy(update={"precision": task.precision}))
        scope: tuple[str | int, ...] = ()
        if before is not None:
            scope = ("lifetime", lifetime)
            solver = task.solvers([Streams(seed, *scope, "solver") for seed in config.seeds])
            latest = load_latest(before.path / "checkpoints")
            if latest is None:
                raise CheckpointError(f"{before.path}: holds no checkpoint to go on learning from")
            curriculum.load_state_dict(latest[1]["curriculum"])
            curriculum.begin()
        value = run(build(config, task, solver, curriculum, folder, signals, scope), config)
        before = folder
    return value


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
        log=make_log(config.logger, folder.path, _name(config)),
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


def run(experiment: Experiment, config: RunConfig) -> float:
    """Run to the end, write summary and picture, say what came out.

    Returns:
        The headline measurement at the end, e.g. for a Hydra sweeper.
    """
    folder = experiment.folder
    identity = _identity(experiment, config)
    finished = _finished(folder.path, config)
    if finished is not None:
        tqdm.write(f"{_name(config)}: finished before, nothing to do. Files: {folder.path}")
        return _value(finished, config)
    folder.write_json("run.json", {**identity, "planned_updates": config.schedule.updates})
    try:
        result = experiment.run()
    except Interrupted as stop:
        tqdm.write(f"{one_line(stop).capitalize()}; all is saved. {_how_to_go_on(folder)}")
        sys.exit(SIGNALLED + stop.signum)
    except KeyboardInterrupt:
        tqdm.write(
            f"Stopped at once; what came after the last checkpoint is lost. {_how_to_go_on(folder)}"
        )
        raise
    except DivergedError as error:
        kept = folder.path / "checkpoints"
        raise DivergedError(
            f"{error}; the last checkpoints before it are kept in {kept}"
        ) from error
    folder.write_json("summary.json", {**identity, **result})
    picture = draw_run(folder.path, title=_name(config))
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        Console().print(screen(read_progress(folder.path)))
    for seed, reached, final in zip(
        config.seeds, result["updates_to_threshold"], result["final"], strict=True
    ):
        tqdm.write(f"{config.method}, seed {seed}: {_outcome_text(result, reached, final)}")
    tqdm.write(_cost_text(result, len(config.seeds)))
    tqdm.write(f"Files: {folder.path}  (picture: {picture.name})")
    return _value(result, config)


def _name(config: RunConfig) -> str:
    ablation = "" if config.ablation == "none" else f"_{config.ablation}"
    return f"{config.method}{ablation}_seed_{'-'.join(map(str, config.seeds))}"


def _value(result: dict[str, Any], config: RunConfig) -> float:
    finals = [float(row[config.schedule.headline]) for row in result["final"]]
    return sum(finals) / len(finals)


def _finished(folder: Path, config: RunConfig) -> dict[str, Any] | None:
    """The summary of a run that is already at the end of its schedule."""
    file = folder / "summary.json"
    summary: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"updates": 0}
    return summary if summary["updates"] >= config.schedule.updates else None


def _how_to_go_on(folder: RunFolder) -> str:
    again = shlex.join([*HydraConfig.get().overrides.task, f"hydra.run.dir={folder.path}"])
    return f"To go on: bin/train {again}"


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


def _identity(experiment: Experiment, config: RunConfig) -> dict[str, Any]:
    device = experiment.solver.env.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else ""
    packages = ("proposer_rl", "torch", "torchrl", "tensordict", "hydra-core")
    parameters = sum(p.numel() for p in experiment.solver.agent.parameters())
    return {
        "method": config.method,
        "scale": config.scale,
        "ablation": config.ablation,
        "seed": config.seed,
        "seeds": config.seeds,
        "overrides": list(HydraConfig.get().overrides.task),
        "solver_parameters": parameters,
        "device": f"{device.type} {name}".strip(),
        "machine": f"{processor()}, {os.cpu_count()} cores, {platform.system()}",
        "threads": torch.get_num_threads(),
        "collector": config.collector,
        "workers": config.workers,
        "versions": {"python": platform.python_version()} | {p: version(p) for p in packages},
    }


def _outcome_text(result: dict[str, Any], reached: int | None, final: dict[str, float]) -> str:
    level = f"{result['threshold']:.0%} {result['headline'].replace('_', ' ')}"
    outcome = (
        f"{level} after {reached} updates"
        if reached is not None
        else f"{level} not reached in {result['updates']} updates (censored)"
    )
    return f"{outcome}; {final[result['headline']]:.1%} at the end."


def _cost_text(result: dict[str, Any], seeds: int) -> str:
    together = f" for each of {seeds} seeds" if seeds > 1 else ""
    return (
        f"Cost: {result['frames']:,} frames of the Solver{together}, "
        f"{result['meta_frames']:,} of its copies, {result['seconds']:.0f} s."
    )


if __name__ == "__main__":
    sys.argv[0] = "train"  # the name in the shell, bin/train: Hydra installs completion for it
    main()
