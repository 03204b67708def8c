"""What a run is, and its results."""

from __future__ import annotations

import os
import platform
import shlex
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from proposer_rl.cli.config import RunConfig
from proposer_rl.cli.groups import overrides
from proposer_rl.cli.help import choices, needs
from proposer_rl.experiment import Experiment
from proposer_rl.recipes import CONFIG_FOLDER, PACKAGE, override_value
from proposer_rl.runs.machine import processor


def run_name(config: RunConfig) -> str:
    """The run's name, in pictures and loggers."""
    ablation = "" if config.ablation == "none" else f"_{config.ablation}"
    return f"{config.method}{ablation}_seed_{'-'.join(map(str, config.seeds))}"


def identity(experiment: Experiment, config: RunConfig) -> dict[str, Any]:
    """What the run is, and what it is made with: method, seeds, machine, versions."""
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
        "about": _about(config),
        "overrides": overrides(),
        "arguments": {"config_dir": _config_folder(), "pythonpath": _python_path()},
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


def to_go_on(path: Path) -> str:
    """The command that goes on with the run in a folder."""
    paths, config = _python_path(), _config_folder()
    before = [f"PYTHONPATH={shlex.quote(paths)}"] if paths else []
    options = ["--config-dir", config] if config else []
    own = [word for word in overrides() if not word.startswith("+sweep=")]
    words = shlex.join([*options, *own, f"hydra.run.dir={quoted(str(path))}"])
    return " ".join([*before, "bin/train", words])


def quoted(path: str) -> str:
    """A path as Hydra's grammar of overrides takes it: in its quotes, where it has to be."""
    with suppress(HydraException):
        if OverridesParser.create().parse_override(f"hydra.run.dir={path}").value() == path:
            return path
    return override_value(path)


def _about(config: RunConfig) -> dict[str, str]:
    """What method and ablation do, in the words of their files; those of one's own, too."""
    own = _config_folder()
    folders = [CONFIG_FOLDER, *([Path(own)] if own else [])]
    chosen = {"method": config.method, "ablation": config.ablation}
    said = {group: choices(group, folders).get(name, "") for group, name in chosen.items()}
    needed = needs(folders).get(config.method)
    return said if needed is None else {**said, "needs": ", ".join(needed)}


def _config_folder() -> str | None:
    """The folder given with ``--config-dir``."""
    sources = HydraConfig.get().runtime.config_sources
    given = (source.path for source in sources if source.provider == "command-line")
    return next(map(_from_here, given), None)


def _python_path() -> str | None:
    """The caller's PYTHONPATH: that of this process without the checkout, which bin/ adds."""
    own = str(PACKAGE.parent)
    given = [part for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part]
    return os.pathsep.join(_from_here(part) for part in given if part != own) or None


def _from_here(path: str) -> str:
    """A path as it can be given again on another machine: from the working folder, if inside it."""
    inside = Path(path).resolve()
    here = Path.cwd().resolve()
    return str(inside.relative_to(here)) if inside.is_relative_to(here) else path
