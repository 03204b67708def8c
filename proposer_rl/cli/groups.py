"""The groups of a composed command: what cannot be together, or in another order."""

from __future__ import annotations

import codecs
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.help import GROUPS
from proposer_rl.recipes import available, yaml_file

# Of these nothing is chosen until a command does.
ADDED = [group.strip("+=") for group in GROUPS if group.startswith("+")]
# And these change a method or a scale, which therefore come before them.
CHANGING = [f"+{group}" for group in ADDED if group not in ("method", "scale", "sweep")]

# ${joined:${seeds}} in the configuration: 0, or 0-1-2 where seeds are trained together.
OmegaConf.register_new_resolver(
    "joined",
    # What is no list is refused later, in a line that names its key.
    lambda items: "-".join(map(str, items)) if isinstance(items, ListConfig) else str(items),
    replace=True,
)


def overrides() -> list[str]:
    """As given on the command line: what they refer to is the run's, not Hydra's own."""
    given: Any = OmegaConf.to_container(HydraConfig.get().overrides.task)
    return list(given)


def check_groups(given: Sequence[str]) -> None:
    """Refuse groups of which one would undo another, since later ones win, or that do not fit."""
    said = dict(override.split("=", 1) for override in given if "=" in override)
    task, scale = said.get("task"), said.get("+scale")
    if task in available("task") and scale in available("scale"):
        defaults = yaml_file("train")["defaults"]
        scaled = next(group["task"] for group in defaults if "task" in group)
        if task != scaled:
            raise ConfigError(
                f"+scale={scale}: is of task={scaled}; task={task} has numbers of its own"
            )
    groups = [override.partition("=")[0] for override in given]
    changing = [place for place, group in enumerate(groups) if group in CHANGING]
    for group in groups[min(changing, default=len(groups)) :]:
        if group in ("+method", "+scale"):
            raise ConfigError(
                f"{group}: must come before {groups[changing[0]]}, or it would undo it"
            )


def check_chosen(config: DictConfig) -> None:
    """Refuse to run without a method, or with a file that Hydra has put below its group.

    It does so with a file of one's own for want of its first line.
    """
    if config.method is None or config.curriculum is None:
        known = ", ".join(available("method"))
        raise ConfigError(f"method: missing; choose one with +method=NAME, NAME one of: {known}")
    for group, name in HydraConfig.get().runtime.choices.items():
        below = config.get(group)
        if not isinstance(below, DictConfig) or group not in below:
            continue
        folders = (Path(source.path) for source in HydraConfig.get().runtime.config_sources)
        files = [folder / group / f"{name}.yaml" for folder in folders]
        file = next((file for file in files if file.is_file()), files[0])
        marked = file.is_file() and file.read_bytes().startswith(codecs.BOM_UTF8)
        hidden = "; a byte-order mark hides it: save the file as UTF-8 without one"
        raise ConfigError(
            f"{group}={name}: the first line of {file} must be '# @package _global_', or its keys "
            f"become {group}.{group} and so on{hidden if marked else ''}"
        )
