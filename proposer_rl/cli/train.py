"""Run one experiment, or with ``-m`` several: ``bin/train``, but for its help."""

from __future__ import annotations

import json
import math
import os
import shlex
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm
from yaml import YAMLError

from proposer_rl.cli.build import Made, build, parts
from proposer_rl.cli.config import ConfigError, RunConfig, check_order, read_config
from proposer_rl.cli.errors import SIGNALLED, UNFORESEEN, command, exit_code, one_line, refuse
from proposer_rl.cli.hydra_errors import explained
from proposer_rl.cli.outcome import announce, identity, overrides, run_name
from proposer_rl.cli.places import CONFIG_FOLDER
from proposer_rl.cli.same_run import check_same_run
from proposer_rl.cli.sweep import forget_failure, record_failure
from proposer_rl.cli.traces import remove_traces
from proposer_rl.experiment import Experiment
from proposer_rl.learning import DivergedError
from proposer_rl.report.levels import draw_run
from proposer_rl.runs.checkpoint import CheckpointError, load_latest
from proposer_rl.runs.folder import RunFolder
from proposer_rl.runs.lock import locked
from proposer_rl.runs.signals import Interrupted, StopSignals
from proposer_rl.runs.status import Status
from proposer_rl.streams import Streams


def main() -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    # Hydra then lets its errors through, so that they can be told in one line.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    command(_compose_and_run)


def _compose_and_run() -> None:
    _refuse_pickles(sys.argv)
    try:
        _main()
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        remove_traces()
        raise ConfigError(explained(error)) from error
    except ValueError as error:
        if HydraConfig.initialized():
            raise
        remove_traces()
        raise ConfigError(one_line(error)) from error  # of an override such as +method=3


@hydra.main(version_base="1.3", config_path=str(CONFIG_FOLDER), config_name="train")
def _main(hydra_config: DictConfig) -> float:
    path = Path(HydraConfig.get().runtime.output_dir)
    signals = StopSignals()
    try:
        forget_failure(path)
        check_order(overrides())
        config = read_config(hydra_config)
        status = Status(config.proposer.meta_episode_length)
        made = parts(config, signals, status)  # whatever is wrong with the input is found here
        with locked(path), signals:
            try:
                return live(config, made, path, signals, status)
            finally:
                made.curriculum.close()
    except Exception as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return record_failure(path, error, one_line(error), exit_code(error))
        if exit_code(error) != UNFORESEEN:
            remove_traces()
            refuse(error)
        raise


def _refuse_pickles(arguments: list[str]) -> None:
    """Hydra's --experimental-rerun reads a pickle, which can run whatever it likes."""
    if any(argument.startswith("--experimental-rerun") for argument in arguments):
        raise ConfigError("--experimental-rerun: not supported; give the run's own arguments again")


def live(
    config: RunConfig, made: Made, path: Path, signals: StopSignals, status: Status | None = None
) -> float:
    """Run all lifetimes: one Solver after another, on a curriculum that goes on learning.

    Args:
        config: the run's settings.
        made: as :func:`parts` makes it; the Solvers are those of the first lifetime.
        path: the run's folder, which has one for each lifetime if there are several.
        signals: which may ask the run to stop.
        status: which tells what the run is doing.

    Returns:
        The headline measurement at the end of the last lifetime.
    """
    value = math.nan
    before: RunFolder | None = None
    for lifetime in range(config.lifetimes):
        folder = RunFolder(path / f"lifetime_{lifetime}" if config.lifetimes > 1 else path)
        # What `auto` has become, so that a run does not go on in another precision elsewhere.
        check_same_run(folder, config.model_copy(update={"precision": made.task.precision}))
        scope: tuple[str | int, ...] = ()
        if before is not None:
            scope = ("lifetime", lifetime)
            streams = [Streams(seed, *scope, "solver") for seed in config.seeds]
            made = made._replace(learner=made.task.learner(streams))
            latest = load_latest(before.path / "checkpoints")
            if latest is None:
                raise CheckpointError(f"{before.path}: holds no checkpoint to go on learning from")
            made.curriculum.load_state_dict(latest[1]["curriculum"])
            made.curriculum.begin()
        value = run(build(config, made, folder, signals, scope, status), config)
        before = folder
    return value


def run(experiment: Experiment, config: RunConfig) -> float:
    """Run to the end, write summary and picture, say what came out.

    Returns:
        The headline measurement at the end, e.g. for a Hydra sweeper.
    """
    folder = experiment.folder
    facts = identity(experiment, config)
    finished = _finished(folder.path, config)
    if finished is not None:
        tqdm.write(f"{run_name(config)}: finished before, nothing to do. Files: {folder.path}")
        return _value(finished, config)
    described = {"planned_updates": config.schedule.updates, "task": experiment.task.facts}
    folder.write_json("run.json", {**facts, **described})
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
    folder.write_json("summary.json", {**facts, **result})
    announce(result, config, folder, draw_run(folder.path, title=run_name(config)))
    return _value(result, config)


def _value(result: dict[str, Any], config: RunConfig) -> float:
    finals = [float(row[config.schedule.headline]) for row in result["final"]]
    return sum(finals) / len(finals)


def _finished(folder: Path, config: RunConfig) -> dict[str, Any] | None:
    """The summary of a run that is already at the end of its schedule."""
    file = folder / "summary.json"
    summary: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {"updates": 0}
    return summary if summary["updates"] >= config.schedule.updates else None


def _how_to_go_on(folder: RunFolder) -> str:
    again = shlex.join([*overrides(), f"hydra.run.dir={folder.path}"])
    return f"To go on: bin/train {again}"
