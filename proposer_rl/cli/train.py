"""``bin/train`` and ``proposer-train``: run one experiment, or with ``-m`` several."""

from __future__ import annotations

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
from tqdm import tqdm

from proposer_rl.capture import use
from proposer_rl.cli.config import CONFIG_FOLDER, ConfigError, RunConfig, check_order, read_config
from proposer_rl.cli.errors import FORESEEN, SIGNALLED, one_line, refuse
from proposer_rl.cli.loggers import make_log
from proposer_rl.cli.picture import draw_run
from proposer_rl.cli.same_run import check_same_run
from proposer_rl.curricula import Curriculum
from proposer_rl.experiment import Experiment
from proposer_rl.finite import DivergedError
from proposer_rl.lock import locked
from proposer_rl.methods import Parts
from proposer_rl.ppo import PPO
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
    try:
        check_order(HydraConfig.get().overrides.task)
        config = read_config(hydra_config)
        path = Path(HydraConfig.get().runtime.output_dir)
        made = parts(config)  # whatever is wrong with the input is found here
        with locked(path), StopSignals() as signals:
            folder = RunFolder(path)
            # What `auto` has become, so that a run does not go on in another precision elsewhere.
            check_same_run(folder, config.model_copy(update={"precision": made[0].precision}))
            return run(build(config, *made, folder, signals), config)
    except FORESEEN as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise  # Hydra goes on with the other runs and fails at the end.
        refuse(error)


def _refuse_pickles(arguments: list[str]) -> None:
    """Hydra's --experimental-rerun reads a pickle, which can run whatever it likes."""
    if any(argument.startswith("--experimental-rerun") for argument in arguments):
        raise ConfigError("--experimental-rerun: not supported; give the run's own arguments again")


def parts(config: RunConfig) -> tuple[MazeTask, PPO, Curriculum]:
    """Task, Solver and curriculum of an experiment; nothing is written yet.

    Raises:
        ConfigError: if settings that are each valid do not go together.
    """
    try:
        task = make_task(config)
        solver = task.solvers([Streams(config.seed, "solver")])
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
) -> Experiment:
    """Put an experiment together.

    Args:
        config: the run's settings.
        task: as :func:`parts` makes it.
        solver: as :func:`parts` makes it.
        curriculum: as :func:`parts` makes it.
        folder: the run's.
        signals: which may ask the run to stop.

    Raises:
        ConfigError: if the logger's package is missing.
    """
    return Experiment(
        solver,
        curriculum,
        schedule=config.schedule,
        seeds=[config.seed],
        folder=folder,
        evaluate=task.measure,
        statistics=task.statistics,
        records=task.records,
        log=make_log(config.logger, folder.path, f"{config.method}_seed_{config.seed}"),
        progress=config.progress,
        signals=signals,
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
    folder.write_json("summary.json", {**_identity(experiment, config), **result})
    picture = draw_run(folder.path, title=f"{config.method}, seed {config.seed}")
    tqdm.write(_summary_text(config, result))
    tqdm.write(f"Files: {folder.path}  (picture: {picture.name})")
    return float(result["final"][0][config.schedule.headline])


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
    parts = Parts(task, config.proposer, config.seed, bar)
    try:
        factory = instantiate(config.curriculum, _partial_=True)
        curriculum = factory(parts)
    except (TypeError, ValueError, HydraException) as error:
        raise ConfigError(f"curriculum: {one_line(error)}") from error
    if not isinstance(curriculum, Curriculum):
        kind = type(curriculum).__name__
        raise ConfigError(f"curriculum: must make a Curriculum, but makes {kind}")
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
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor()
    packages = ("proposer_rl", "torch", "torchrl", "tensordict", "hydra-core")
    parameters = sum(p.numel() for p in experiment.solver.agent.parameters())
    return {
        "method": config.method,
        "scale": config.scale,
        "ablation": config.ablation,
        "seed": config.seed,
        "overrides": list(HydraConfig.get().overrides.task),
        "solver_parameters": parameters,
        "device": f"{device.type} {name}".strip(),
        "threads": torch.get_num_threads(),
        "versions": {"python": platform.python_version()} | {p: version(p) for p in packages},
    }


def _summary_text(config: RunConfig, result: dict[str, Any]) -> str:
    reached = result["updates_to_threshold"][0]
    level = f"{result['threshold']:.0%} {result['headline'].replace('_', ' ')}"
    final = result["final"][0][result["headline"]]
    outcome = (
        f"{level} after {reached} updates"
        if reached is not None
        else f"{level} not reached in {result['updates']} updates (censored)"
    )
    return (
        f"{config.method}, seed {config.seed}: {outcome}; {final:.1%} at the end. "
        f"Cost: {result['frames']:,} frames of the Solver, "
        f"{result['meta_frames']:,} of its copies, {result['seconds']:.0f} s."
    )


if __name__ == "__main__":
    main()
