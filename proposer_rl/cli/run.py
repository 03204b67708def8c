"""One experiment from its checked settings, and what is written beside it."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from signal import Signals
from typing import Any

import torch

from proposer_rl.cli.build import Made, build, parts
from proposer_rl.cli.config import RunConfig, stored_config
from proposer_rl.cli.errors import ConfigError, one_line, say
from proposer_rl.cli.groups import Invocation, quoted
from proposer_rl.cli.help import choices, needs
from proposer_rl.cli.loggers import logger
from proposer_rl.experiment import Experiment
from proposer_rl.meta.workers import WorkersError
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.checkpoint import checkpoint_bytes, checkpoint_files
from proposer_rl.runs.folder import PROPOSER, RunFolder, storage, write_atomically
from proposer_rl.runs.process import Interrupted, Status, StopSignals, locked, processor
from proposer_rl.runs.records import TaskFacts, checked, small_json

SUMMARY = "summary.json"
# What may differ: where it is computed and shown, and a longer schedule.
FREE = {"compute", "logger"}
FREE_SCHEDULE = {"updates", "checkpoint_every", "checkpoint_seconds", "keep_checkpoints"}

FALLING = "solver.ppo.anneal_updates"


Show = Callable[[Path, str, Mapping[str, Any]], None]
"""Shows a run that is over, given its folder, name and summary; training itself draws nothing."""


def train(config: RunConfig, asked: Invocation, signals: StopSignals, show: Show) -> float:
    """Carries out a run for the command line; where it is stopped, says how it goes on, and exits.

    Returns:
        The headline measurement at the end, e.g. for a Hydra sweeper.
    """
    try:
        return carry_out(config, asked, signals, show)
    except Interrupted as stop:
        name = Signals(stop.signum).name
        say(f"Stopped by {name}; all is saved. To go on: {to_go_on(asked)}")
        if "SUBMITIT_EXECUTOR" in os.environ:  # the sweep that sent this job waits for its result
            raise
        sys.exit(stop.exit_code)
    except KeyboardInterrupt:
        stopped = "Stopped at once; what came after the last checkpoint is lost"
        say(f"{stopped}. To go on: {to_go_on(asked)}")
        raise


@torch.inference_mode(False)  # also where it is called without gradients
def carry_out(config: RunConfig, asked: Invocation, signals: StopSignals, show: Show) -> float:
    """Makes the parts of an experiment, and runs it in a folder that it locks meanwhile.

    It is called inside the context of the signals that may ask the run to stop.

    Returns:
        The headline measurement at the end.

    Raises:
        Interrupted: if a signal asked the run to stop; all is saved then.
    """
    status = Status(config.proposer.meta_episode_length)
    config = as_begun(config, asked.folder)
    made = parts(config, signals, status)  # whatever is wrong with the input is found here
    try:
        checked(TaskFacts, made.task.facts, "task")  # as the run's readers will at its end
    except ValueError as error:
        raise ConfigError(one_line(error)) from error
    with locked(asked.folder):
        try:
            result = proceed(config, made, asked, signals, status, show)
            signals.deliver()  # of a sweep the next run is not to begin
        except Interrupted as stop:
            stop.folder = asked.folder
            raise
        except WorkersError as error:
            raise WorkersError(f"compute.{error}") from error
        finally:
            for curriculum in made.curricula:
                curriculum.close()
    finals = [float(row[config.schedule.headline]) for row in result["final"]]
    return sum(finals) / len(finals)


def proceed(
    config: RunConfig,
    made: Made,
    asked: Invocation,
    signals: StopSignals,
    status: Status,
    show: Show,
) -> dict[str, Any]:
    """Begins a run, resumes it, or says that it is finished; returns its summary."""
    path = asked.folder
    folder = RunFolder(path)
    # What `auto` has become, so that a run goes on in the same precision elsewhere.
    precision: Any = made.task.precision
    check_same_run(folder, replace(config, precision=precision))
    finished = _finished(path, config.schedule.updates)
    if finished is not None:
        say(f"{run_name(config)}: finished before, nothing to do. Files: {path}")
        return finished
    with logger(config.logger, path, run_name(config), asdict(config)) as log:
        experiment = build(config, made, folder, signals, status, log)
        facts = identity(experiment, config, asked)
        described = {"planned_updates": config.schedule.updates, "task": made.task.facts}
        folder.write_json("run.json", {**facts, **described})
        result = experiment.run()
        if learnt := made.curricula[0].learnt():
            content = checkpoint_bytes(experiment.updates, {"curriculum": learnt})
            write_atomically(path / PROPOSER, content)
        summary = {**facts, **result}
        folder.write_json(SUMMARY, summary)
    show(path, run_name(config), summary)
    return summary


def _finished(folder: Path, updates: int) -> dict[str, Any] | None:
    """Returns the summary of a run that is already at the end of a schedule; else None.

    One that goes on to a longer schedule has none until it ends again.
    """
    file, checkpoints = folder / SUMMARY, folder / "checkpoints"
    summary: dict[str, Any] | None = small_json(file)
    if summary is None or summary["updates"] >= updates:
        return summary
    if not checkpoint_files(checkpoints):
        raise ConfigError(
            f"schedule.updates={updates}: the run in {folder} ended after {summary['updates']} "
            "updates and has no checkpoint to go on from"
        )
    with storage(file):
        file.unlink()
    return None


def check_same_run(folder: RunFolder, config: RunConfig) -> None:
    """Refuses to go on with a run that was started with other settings.

    The stored configuration is compared with the present one and used for nothing else. If there is
    none, the present one is written.
    """
    now = {key: value for key, value in asdict(config).items() if key not in FREE}
    now["schedule"] = {k: v for k, v in now["schedule"].items() if k not in FREE_SCHEDULE}
    file, wrong = folder.path / "config.json", f"hydra.run.dir={folder.path}:"
    if not file.exists():
        # Tables here are no run's of ours, and a run begins by removing what is left of one.
        foreign = sorted([*folder.lengths(), *(p.name for p in folder.path.glob("checkpoints"))])
        if foreign:
            raise ConfigError(
                f"{wrong} holds {foreign[0]} but no config.json, so it is no run's folder; give "
                "another"
            )
        folder.write_json(file.name, now)
        return
    before = stored_config(file)
    differing = _different(before, now)
    if differing:
        key, (old, new) = next(iter(differing.items()))
        falls = "; by default it is schedule.updates: a longer run needs a new folder"
        raise ConfigError(
            f"{key}={new!r:.80}: the run in {folder.path} was started with {old!r:.80}; "
            f"differing keys: {', '.join(differing)}{falls * ([*differing] == [FALLING])}"
        )


def as_begun(config: RunConfig, path: Path) -> RunConfig:
    """Returns the settings with the precision that ``auto`` meant where the run was begun."""
    file = path / "config.json"
    if config.precision != "auto" or not file.is_file():
        return config
    match stored_config(file):
        case {"precision": ("fp32" | "bf16") as precision}:
            return replace(config, precision=precision)
    return config


def _different(before: Any, now: Any, prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """Returns both values of every key that differs, by its dotted name."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return {} if before == now else {prefix.rstrip("."): (before, now)}
    return {
        name: values
        for key in sorted(before.keys() | now.keys())
        for name, values in _different(before.get(key), now.get(key), f"{prefix}{key}.").items()
    }


def run_name(config: RunConfig) -> str:
    """Returns the run's name, for pictures and loggers."""
    ablation = "" if config.ablation == "none" else f"_{config.ablation}"
    return f"{config.method}{ablation}_seed_{'-'.join(map(str, config.seeds))}"


def identity(experiment: Experiment, config: RunConfig, asked: Invocation) -> dict[str, Any]:
    """Returns what the run is, and what it is made with: method, seeds, machine, versions."""
    device = experiment.task.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else ""
    packages = ("proposer_rl", "torchrl", "tensordict", "hydra-core")
    parameters = sum(p.numel() for p in experiment.learner.agent.parameters())
    return {
        "method": config.method,
        "scale": config.scale,
        "ablation": config.ablation,
        "seed": config.seed,
        "seeds": config.seeds,
        "about": _about(config, asked.config_dir),
        "overrides": asked.overrides,
        "settings": asked.settings,
        "arguments": {"config_dir": asked.config_dir, "pythonpath": asked.python_path},
        "solver_parameters": parameters // len(config.seeds),
        "device": f"{device.type} {name}".strip(),
        "machine": f"{processor()}, {os.cpu_count()} cores, {platform.system()}",
        "threads": torch.get_num_threads(),
        "collector": config.compute.collector,
        "workers": config.compute.workers,
        "versions": {
            "python": platform.python_version(),
            "torch": str(torch.__version__),  # with its build, which not all of its wheels tell
            **{package: version(package) for package in packages},
        },
    }


def to_go_on(asked: Invocation) -> str:
    """Returns the command that resumes a run."""
    paths, config = asked.python_path, asked.config_dir
    before = [f"PYTHONPATH={shlex.quote(paths)}"] if paths else []
    options = ["--config-dir", config] if config else []
    own = [word for word in asked.overrides if not word.startswith("sweep=")]
    words = shlex.join([*options, *own, quoted("hydra.run.dir", str(asked.folder))])
    return " ".join([*before, "bin/train", words])


def _about(config: RunConfig, own: str | None) -> dict[str, str]:
    """Returns what method and ablation do, by the first lines of their files."""
    folders = [CONFIG_FOLDER, *([Path(own)] if own else [])]
    chosen = {"method": config.method, "ablation": config.ablation}
    said = {group: choices(group, folders).get(name, "") for group, name in chosen.items()}
    needed = needs(folders).get(config.method)
    return said if needed is None else {**said, "needs": ", ".join(needed)}
