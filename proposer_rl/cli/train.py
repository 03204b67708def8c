"""``bin/train`` and ``proposer-train``: run one experiment, or with ``-m`` several."""

from __future__ import annotations

import json
import os
import platform
import shlex
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from proposer_rl.capture import use
from proposer_rl.checkpoint import CheckpointError
from proposer_rl.cli.config import CONFIG_FOLDER, ConfigError, RunConfig, check_order, read_config
from proposer_rl.cli.loggers import make_log
from proposer_rl.cli.picture import draw_run
from proposer_rl.curricula import Curriculum
from proposer_rl.experiment import Experiment
from proposer_rl.methods import Parts
from proposer_rl.run_folder import RunFolder
from proposer_rl.streams import Streams
from proposer_rl.task import MazeTask, faster_precision

INPUT_ERRORS = (ConfigError, CheckpointError)
BAD_INPUT = 2
INTERRUPTED = 130


def main() -> None:
    """Entry point: exit code 0 after a run, 2 for bad input, 130 when interrupted."""
    # Hydra then lets its errors through, so that they can be told in one line.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        _main()
    except (*INPUT_ERRORS, HydraException, OmegaConfBaseException) as error:
        _refuse(error)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


@hydra.main(version_base="1.3", config_path=str(CONFIG_FOLDER), config_name="train")
def _main(hydra_config: DictConfig) -> float:
    try:
        check_order(HydraConfig.get().overrides.task)
        config = read_config(hydra_config)
        experiment = build(config, Path(HydraConfig.get().runtime.output_dir))
        return run(experiment, config)
    except INPUT_ERRORS as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            raise  # Hydra goes on with the other runs and fails at the end.
        _refuse(error)


def _refuse(error: Exception) -> NoReturn:
    """Say in one line what is wrong with the input, and exit."""
    if isinstance(error, MissingConfigException) and error.options:
        message = f"{error.missing_cfg_file}: unknown; choose one of: {', '.join(error.options)}"
    else:
        message = _one_line(error)
    print(f"error: {message}", file=sys.stderr)
    sys.exit(BAD_INPUT)


def build(config: RunConfig, path: Path) -> Experiment:
    """Put an experiment together.

    Args:
        config: the run's settings.
        path: the run's folder.

    Raises:
        ConfigError: if settings that are each valid do not make an experiment.
    """
    try:
        task = make_task(config)
        curriculum = _curriculum(config, task)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    # What `auto` has become, so that a run does not go on in another precision elsewhere.
    config = config.model_copy(update={"precision": task.precision})
    folder = RunFolder(path)
    _check_same_run(folder, config)
    return Experiment(
        task.solvers([Streams(config.seed, "solver")]),
        curriculum,
        schedule=config.schedule,
        seeds=[config.seed],
        folder=folder,
        evaluate=task.measure,
        statistics=task.statistics,
        records=task.records,
        log=make_log(config.logger, path, f"{config.method}_seed_{config.seed}"),
        progress=config.progress,
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
    except KeyboardInterrupt:
        again = shlex.join([*HydraConfig.get().overrides.task, f"hydra.run.dir={folder.path}"])
        tqdm.write(f"Interrupted. To go on from the last checkpoint: bin/train {again}")
        raise
    folder.write_json("summary.json", {**_identity(experiment, config), **result})
    picture = draw_run(folder.path, title=f"{config.method}, seed {config.seed}")
    tqdm.write(_summary_text(config, result))
    tqdm.write(f"Files: {folder.path}  (picture: {picture.name})")
    return float(result["final"][0][config.schedule.headline])


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
        return factory(parts)
    except TypeError as error:
        raise ConfigError(f"curriculum: {_one_line(error)}") from error


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        reason = _one_line(error)
        raise ConfigError(
            f"device={name!r}: must be auto, cpu or a usable one: {reason}"
        ) from error


def _check_same_run(folder: RunFolder, config: RunConfig) -> None:
    """Refuse to go on with a run that was started with other settings."""
    # What may differ: where and how it is computed and shown, and a longer schedule.
    free = {"device", "graphs", "threads", "cores", "progress", "logger"}
    now = config.model_dump(mode="json", exclude=free)
    now["schedule"].pop("updates")
    file = folder.path / "config.json"
    if file.exists():
        before = json.loads(file.read_text())
        differing = sorted(_different(before, now))
        if differing:
            key = differing[0]
            raise ConfigError(
                f"{key}: the run in {folder.path} was started with another value; "
                f"differing keys: {', '.join(differing)}"
            )
    else:
        folder.write_json(file.name, now)


def _different(before: Any, now: Any, prefix: str = "") -> list[str]:
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return [] if before == now else [prefix.rstrip(".")]
    keys = before.keys() | now.keys()
    return [
        name
        for key in keys
        for name in _different(before.get(key), now.get(key), f"{prefix}{key}.")
    ]


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


def _one_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines()]
    return " ".join(line for line in lines if line)


if __name__ == "__main__":
    main()
