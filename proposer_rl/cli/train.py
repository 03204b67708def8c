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
from rich.console import Console
from tqdm import tqdm

from proposer_rl.capture import use
from proposer_rl.checkpoint import CheckpointError
from proposer_rl.cli.config import CONFIG_FOLDER, ConfigError, RunConfig, check_order, read_config
from proposer_rl.cli.loggers import make_log
from proposer_rl.cli.sweep import forget_failure, record_failure
from proposer_rl.curricula import Curriculum
from proposer_rl.experiment import Experiment
from proposer_rl.machine import processor
from proposer_rl.methods import Parts
from proposer_rl.report.levels import draw_run
from proposer_rl.report.progress import read_progress
from proposer_rl.report.terminal import screen
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
    path = Path(HydraConfig.get().runtime.output_dir)
    try:
        forget_failure(path)
        check_order(HydraConfig.get().overrides.task)
        config = read_config(hydra_config)
        experiment = build(config, path)
        return run(experiment, config)
    except Exception as error:
        foreseen = isinstance(error, INPUT_ERRORS)
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return record_failure(path, error, _one_line(error), BAD_INPUT if foreseen else 1)
        if foreseen:
            _refuse(error)
        raise


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
        task.solvers([Streams(seed, "solver") for seed in config.seeds]),
        curriculum,
        schedule=config.schedule,
        seeds=config.seeds,
        folder=folder,
        evaluate=task.measure,
        statistics=task.statistics,
        records=task.records,
        log=make_log(config.logger, path, _name(config)),
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
    identity = _identity(experiment, config)
    finished = _finished(folder.path, config)
    if finished is not None:
        tqdm.write(f"{_name(config)}: finished before, nothing to do. Files: {folder.path}")
        return _value(finished, config)
    folder.write_json("run.json", {**identity, "planned_updates": config.schedule.updates})
    try:
        result = experiment.run()
    except KeyboardInterrupt:
        again = shlex.join([*HydraConfig.get().overrides.task, f"hydra.run.dir={folder.path}"])
        tqdm.write(f"Interrupted. To go on from the last checkpoint: bin/train {again}")
        raise
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
    parts = Parts(task, config.proposer, config.seeds[0], bar)
    try:
        factory = instantiate(config.curriculum, _partial_=True)
        curriculum: Curriculum = factory(parts)
    except TypeError as error:
        raise ConfigError(f"curriculum: {_one_line(error)}") from error
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


def _one_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines()]
    return " ".join(line for line in lines if line)


if __name__ == "__main__":
    main()
