"""Carries out one run from its validated settings, and writes what describes it."""

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
from proposer_rl.meta.workers import WorkersError
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.checkpoint import checkpoint_bytes, checkpoint_files
from proposer_rl.runs.folder import PROPOSER, RunFolder, storage, write_atomically
from proposer_rl.runs.process import Interrupted, Status, StopSignals, locked, processor
from proposer_rl.runs.records import TaskFacts, checked, small_json
from proposer_rl.task import Task

SUMMARY = "summary.json"
# A resumed run may differ in these: where it is computed and shown, and how long it is.
FREE = {"compute", "logger"}
FREE_SCHEDULE = {"updates", "checkpoint_every", "checkpoint_seconds", "keep_checkpoints"}

FALLING = "solver.ppo.anneal_updates"


Show = Callable[[Path, str, Mapping[str, Any]], None]
"""Shows a finished run, given its folder, name and summary."""


def train(config: RunConfig, asked: Invocation, signals: StopSignals, show: Show) -> float:
    """Carries out a run for the command line; if it is stopped, prints how to resume it, and exits.

    Returns:
        The headline measurement at the end, for Hydra's sweepers.
    """
    try:
        return carry_out(config, asked, signals, show)
    except Interrupted as stop:
        name = Signals(stop.signum).name
        say(f"Stopped by {name}; all is saved. To go on: {to_go_on(asked)}")
        if "SUBMITIT_EXECUTOR" in os.environ:  # the sweep that submitted this job awaits a result
            raise
        sys.exit(stop.exit_code)
    except KeyboardInterrupt:
        stopped = "Stopped at once; updates since the last checkpoint are lost"
        say(f"{stopped}. To go on: {to_go_on(asked)}")
        raise


@torch.inference_mode(False)  # also where it is called without gradients
def carry_out(config: RunConfig, asked: Invocation, signals: StopSignals, show: Show) -> float:
    """Builds an experiment and runs it in its folder, which is locked meanwhile.

    Call it inside the context of ``signals``.

    Returns:
        The headline measurement at the end.

    Raises:
        Interrupted: if a signal asked the run to stop; all is saved then.
    """
    status = Status(config.proposer.meta_episode_length)
    config = as_begun(config, asked.folder)
    made = parts(config, signals, status)  # refuses wrong input
    try:
        checked(TaskFacts, made.task.facts, "task")  # now, since reports would refuse them later
    except ValueError as error:
        raise ConfigError(one_line(error)) from error
    with locked(asked.folder):
        try:
            result = proceed(config, made, asked, signals, status, show)
            signals.deliver()  # so that the next run of a sweep does not begin
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
    """Starts or resumes a run, or says that it is finished; returns its summary."""
    path = asked.folder
    folder = RunFolder(path)
    # The precision that `auto` stands for here, so that the run keeps it on other machines.
    precision: Any = made.task.precision
    check_same_run(folder, replace(config, precision=precision))
    finished = _finished(path, config.schedule.updates)
    if finished is not None:
        say(f"{run_name(config)}: finished before, nothing to do. Files: {path}")
        return finished
    with logger(config.logger, path, run_name(config), asdict(config)) as log:
        experiment = build(config, made, folder, signals, status, log)
        facts = identity(made.task, config, asked)
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
    """Returns the summary of a run that has reached the end of the schedule; else None.

    The summary of a run that goes on to a longer schedule is removed.
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
    """Refuses to resume a run that was started with other settings.

    The stored configuration is only compared with the present one. If there is none, the present
    one is stored.
    """
    now = {key: value for key, value in asdict(config).items() if key not in FREE}
    now["schedule"] = {k: v for k, v in now["schedule"].items() if k not in FREE_SCHEDULE}
    file, wrong = folder.path / "config.json", f"hydra.run.dir={folder.path}:"
    if not file.exists():
        # Tables here belong to something else, and a new run would remove them.
        foreign = sorted([*folder.lengths(), *(p.name for p in folder.path.glob("checkpoints"))])
        if foreign:
            raise ConfigError(
                f"{wrong} holds {foreign[0]} but no config.json, so it is not a run's folder; use "
                "another one"
            )
        folder.write_json(file.name, now)
        return
    before = stored_config(file)
    differing = _different(before, now)
    if differing:
        key, (old, new) = next(iter(differing.items()))
        falls = "; its default is schedule.updates, so a longer run needs a new folder"
        raise ConfigError(
            f"{key}={new!r:.80}: the run in {folder.path} was started with {old!r:.80}; "
            f"differing keys: {', '.join(differing)}{falls * ([*differing] == [FALLING])}"
        )


def as_begun(config: RunConfig, path: Path) -> RunConfig:
    """Returns the settings with the precision that ``auto`` stood for where the run was started."""
    file = path / "config.json"
    if config.precision != "auto" or not file.is_file():
        return config
    match stored_config(file):
        case {"precision": ("fp32" | "bf16") as precision}:
            return replace(config, precision=precision)
    return config


def _different(before: Any, now: Any, prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """Returns the two values of every key that differs, by its dotted name."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return {} if before == now else {prefix.rstrip("."): (before, now)}
    return {
        name: values
        for key in sorted(before.keys() | now.keys())
        for name, values in _different(before.get(key), now.get(key), f"{prefix}{key}.").items()
    }


def run_name(config: RunConfig) -> str:
    """Returns a run's name for pictures and loggers."""
    ablation = "" if config.ablation == "none" else f"_{config.ablation}"
    return f"{config.method}{ablation}_seed_{'-'.join(map(str, config.seeds))}"


def identity(task: Task, config: RunConfig, asked: Invocation) -> dict[str, Any]:
    """Returns what identifies a run: method, seeds, command, machine and versions."""
    device = task.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else ""
    packages = ("proposer_rl", "torchrl", "tensordict", "hydra-core")
    return {
        "method": config.method,
        "seeds": config.seeds,
        "about": _about(config, asked.config_dir),
        "overrides": asked.overrides,
        "settings": asked.settings,
        "arguments": {"config_dir": asked.config_dir, "pythonpath": asked.python_path},
        "device": f"{device.type} {name}".strip(),
        "machine": f"{processor()}, {os.cpu_count()} cores, {platform.system()}",
        "threads": torch.get_num_threads(),
        "versions": {
            "python": platform.python_version(),
            "torch": str(torch.__version__),  # with its build, which some wheels' metadata lack
            **{package: version(package) for package in packages},
        },
    }


def to_go_on(asked: Invocation) -> str:
    """Returns the command that resumes a run."""
    paths, config = asked.python_path, asked.config_dir
    before = [f"PYTHONPATH={shlex.quote(paths)}"] if paths else []
    options = ["--config-dir", config] if config else []
    own = [word for word in asked.overrides if not word.startswith("+sweep=")]
    words = shlex.join([*options, *own, quoted("hydra.run.dir", str(asked.folder))])
    return " ".join([*before, "bin/train", words])


def _about(config: RunConfig, own: str | None) -> dict[str, str]:
    """Returns the descriptions of the method, and of its ablation if any, from their files."""
    folders = [CONFIG_FOLDER, *([Path(own)] if own else [])]
    chosen = {"method": config.method, "ablation": config.ablation}
    said = {
        group: choices(group, folders).get(name, "")
        for group, name in chosen.items()
        if name != "none"
    }
    needed = needs(folders).get(config.method)
    return said if needed is None else {**said, "needs": ", ".join(needed)}
