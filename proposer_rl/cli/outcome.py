"""What a run is, and its results."""

from __future__ import annotations

import os
import platform
import shlex
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from rich.console import Console
from tqdm import tqdm

from proposer_rl.cli.config import RunConfig
from proposer_rl.cli.groups import overrides
from proposer_rl.cli.help import choices, needs
from proposer_rl.experiment import Experiment
from proposer_rl.recipes import CONFIG_FOLDER, PACKAGE, override_value
from proposer_rl.report.progress import read_progress
from proposer_rl.report.records import level_text
from proposer_rl.report.terminal import screen
from proposer_rl.runs.folder import RunFolder, is_rate
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


def announce(result: dict[str, Any], config: RunConfig, folder: RunFolder, picture: Path) -> None:
    """Print the results; on one screen, unless the run is one of a sweep's."""
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        console = Console()
        with console.capture() as shown:
            console.print(screen(read_progress(folder.path)))
        say(shown.get().removesuffix("\n"))
    for seed, reached, final in zip(
        config.seeds, result["updates_to_threshold"], result["final"], strict=True
    ):
        say(f"{config.method}, seed {seed}: {_outcome_text(result, reached, final)}")
    say(_cost_text(result, len(config.seeds)))
    say(f"Files: {folder.path}  (picture: {picture.name})")


def say(text: str) -> None:
    """Print a text on standard output, which may be a user's own: in signs that it has."""
    encoding = sys.stdout.encoding or "utf-8"
    tqdm.write(text.encode(encoding, "replace").decode(encoding))


def _outcome_text(result: dict[str, Any], reached: int | None, final: dict[str, float]) -> str:
    headline = result["headline"]
    level = f"{level_text(headline, result['threshold'])} {headline.replace('_', ' ')}"
    end = f"{final[headline]:.1%}" if is_rate(headline) else f"{final[headline]:.3g}"
    outcome = (
        f"{level} after {reached} updates"
        if reached is not None
        else f"{level} not reached in {result['updates']} updates (censored)"
    )
    return f"{outcome}; {end} at the end."


def _cost_text(result: dict[str, Any], seeds: int) -> str:
    together = f" for each of {seeds} seeds" if seeds > 1 else ""
    return (
        f"Cost: {result['frames']:,} frames of the Solver{together}, "
        f"{result['curriculum_frames']:,} of its curriculum, {result['seconds']:.0f} s."
    )
