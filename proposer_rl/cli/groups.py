"""What is wrong with a command that Hydra composes, or cannot compose, in one line."""

from __future__ import annotations

import codecs
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    KeyValidationError,
    OmegaConfBaseException,
)

from proposer_rl.cli.errors import ConfigError, one_line
from proposer_rl.cli.help import GROUPS, own_folders
from proposer_rl.extras import install_command
from proposer_rl.recipes import available, yaml_file

# Of these nothing is chosen until a command does.
ADDED = [group.strip("+=") for group in GROUPS if group.startswith("+")]
# And these change a method or a scale, which therefore come before them.
CHANGING = [f"+{group}" for group in ADDED if group not in ("method", "scale", "sweep")]

LAUNCHERS = [f"hydra/launcher/{name}" for name in ("joblib", "submitit_local", "submitit_slurm")]
_NOT_CHOSEN = re.compile(r"Could not override '(\w+)'\. No match in the defaults list")

# ${joined:${seeds}} in the configuration: 0, or 0-1-2 where seeds are trained together.
OmegaConf.register_new_resolver(
    "joined",
    # What is no list is refused later, in a line that names its key.
    lambda items: "-".join(map(str, items)) if isinstance(items, ListConfig) else str(items),
    replace=True,
)


def overrides() -> list[str]:
    """Returns the overrides of the command line, with the run's interpolations unresolved."""
    given: Any = OmegaConf.to_container(HydraConfig.get().overrides.task)
    return list(given)


def check_groups(given: Sequence[str]) -> None:
    """Refuses groups that would undo each other, since later ones win, or that do not fit."""
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
    """Refuses a run without a method, and a file that Hydra has put below its group.

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


def explained(error: Exception) -> str:
    """Returns one line on an error from composing a configuration."""
    if isinstance(error, UnicodeDecodeError):
        return _not_utf8(error)
    if isinstance(error, MissingConfigException):
        return _no_such_file(error)
    cause = error.__cause__
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return _no_such_key(cause)
    if isinstance(cause, KeyValidationError):
        return unquoted(cause.full_key or "a file", cause.key)
    if "DictConfig with ListConfig" in f"{error} {cause}":
        return _no_mapping(error)
    not_chosen = _NOT_CHOSEN.match(str(error))
    if not_chosen and not_chosen[1] in ADDED:
        group, known = not_chosen[1], ", ".join(available(not_chosen[1]))
        return f"{group}: choose one with +{group}=NAME, NAME one of: {known}"
    if isinstance(error, OverrideParseException):
        said = one_line(error).partition(" See https:")[0]
        return (
            f"{error.override}: cannot be read as KEY=VALUE ({said}); a value with other signs "
            "than letters, digits and /:-+.$%*@?|_ has quotes of its own: \"KEY='VALUE'\""
        )
    return one_line(error)


def unquoted(place: str, read: object) -> str:
    """Returns one line on a name that YAML takes for one of its constants."""
    words = {True: "on, yes or true", False: "off, no or false", None: "null or ~"}
    name = f"{words[read]} without quotes" if read in words else repr(read)
    return f'{place}: {name} is no name here; a name has quotes, as in "on":'


def _no_mapping(error: Exception) -> str:
    """Returns one line that says where the list is that should be a mapping."""
    said, *_ = str(error).splitlines()
    name, *_ = said.removeprefix("Error merging override ").split(": Config")
    name = name.removeprefix("In '").removesuffix("'")
    files = (folder / f"{name}.yaml" for folder in own_folders(sys.argv))
    read = (yaml.safe_load(file.read_bytes()) for file in files if file.is_file())
    lists = [key for content in read for key in _lists(content)]
    named = f" (it has lists in {', '.join(lists)})" if lists else ""
    return f"{name}: a list where there must be a mapping, {{NAME: VALUE}}{named}"


def _lists(node: Any, place: str = "") -> Iterator[str]:
    for key, value in node.items() if isinstance(node, dict) else ():
        here = f"{place}.{key}" if place else str(key)
        if isinstance(value, list) and here != "defaults":
            yield here
        yield from _lists(value, here)


def _not_utf8(error: UnicodeDecodeError) -> str:
    """Returns one line that names the file, searched in the folders that the command names."""
    files = (file for folder in own_folders(sys.argv) for file in sorted(folder.rglob("*.yaml")))
    named = [f"{file}: " for file in files if file.read_bytes().startswith(error.object)]
    return f"{''.join(named[:1])}is not encoded in UTF-8; save it so ({one_line(error)})"


def _no_such_file(error: MissingConfigException) -> str:
    file = error.missing_cfg_file
    if file in LAUNCHERS:
        return f"{file}: its package is missing; install it with: {install_command('launchers')}"
    known = f"; choose one of: {', '.join(error.options)}" if error.options else ""
    return f"{file}: unknown{known}"


def _no_such_key(error: OmegaConfBaseException) -> str:
    holder = error.parent_node
    if not isinstance(holder, DictConfig):
        return one_line(error)
    known = sorted(str(key) for key in holder if holder._get_full_key(key) != "hydra")
    return f"{error.full_key}: unknown; there are: {', '.join(known) or 'none'}"
