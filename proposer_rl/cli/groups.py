"""Reads what a command asks for: its overrides, its groups, and the errors in them."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf

from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.help import GROUPS
from proposer_rl.recipes import CONFIG_FOLDER, PACKAGE, available

# Below these keys are the settings of curricula, most of which are in no file.
BUILT = ("curriculum.", "filter.", "model.")
# The folders of a sweep are not named after these: they say where a run is computed and shown, or
# have a place of their own in the name.
UNNAMED = {"compute", "logger", "method", "seed", "seeds", "sweep"}
LONGEST = 120  # characters of a folder's name that come from overrides


class Invocation(NamedTuple):
    """Holds how a run was asked for, fixed when its configuration is composed.

    Attributes:
        folder: the run's, absolute.
        overrides: as on the command line, with the run's references unresolved.
        config_dir: given with ``--config-dir``; relative if it lies in the working folder.
        python_path: the caller's, without the checkout, which ``bin/`` adds.
        settings: that :func:`proposer_rl.train` merges into what is composed; None of a command.
    """

    folder: Path
    overrides: list[str]
    config_dir: str | None = None
    python_path: str | None = None
    settings: dict[str, Any] | None = None


def invocation(hydra: Any, folder: Path) -> Invocation:
    """Returns how a command asks for a run, from Hydra's configuration of it."""
    given = [s.path for s in hydra.runtime.config_sources if s.provider == "command-line"]
    overrides: Any = OmegaConf.to_container(hydra.overrides.task)
    here = next(map(_from_here, given), None)
    return Invocation(folder.expanduser().absolute(), documented(overrides), here, python_path())


def documented(overrides: Sequence[str]) -> list[str]:
    """Returns overrides in the spelling of help and docs, ``+method=plr``; see :func:`arranged`."""
    return [f"+{o}" if f"+{o.partition('=')[0]}=" in GROUPS else o for o in overrides]


def python_path() -> str | None:
    """Returns PYTHONPATH without the checkout; its folders are relative in the working one."""
    own = str(PACKAGE.parent)
    paths = [part for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part]
    return os.pathsep.join(_from_here(part) for part in paths if part != own) or None


def _from_here(path: str) -> str:
    """Returns a path relative to the working folder if it lies inside, else unchanged."""
    inside = Path(path).resolve()
    here = Path.cwd().resolve()
    return str(inside.relative_to(here)) if inside.is_relative_to(here) else path


def arranged(overrides: Sequence[str]) -> list[str]:
    """Returns overrides in the spelling in which Hydra takes them.

    ``+method=plr`` becomes ``method=plr``, since the groups of ``conf/`` are in the defaults list
    of ``conf/train.yaml``, which has their order. Settings of a curriculum may have their defaults
    in Python and be in no file, so ``filter.times=8`` becomes ``++filter.times=8``. A run's or
    sweep's folder may begin with ``~``, the home folder.

    Raises:
        ConfigError: if a group is set to what cannot be a file's name, such as ``task=null``.
        HydraException: if one is not in Hydra's grammar.
    """
    words = [_at_home(word) for word in overrides]
    return [*map(_spelled, OverridesParser.create().parse_overrides(words))]


def quoted(key: str, text: str) -> str:
    """Returns an override that sets a text, in quotes where Hydra's grammar needs them."""
    with suppress(HydraException):
        if OverridesParser.create().parse_override(f"{key}={text}").value() == text:
            return f"{key}={text}"
    # Hydra takes backslashes as they are, except before a quote, where each must be doubled.
    text = re.sub(r"(\\+)('|\Z)", r"\1\1\2", text).replace("'", r"\'")
    return f"{key}='{text}'"


def _at_home(word: str) -> str:
    key, _, value = word.partition("=")
    folder = value.strip("'\"")
    home = folder.startswith("~") and key in ("hydra.run.dir", "hydra.sweep.dir")
    return quoted(key, str(Path(folder).expanduser())) if home else word


def _spelled(parsed: Override) -> str:
    """Returns an override as Hydra takes it; see :func:`arranged`."""
    word, group = str(parsed.input_line), parsed.key_or_group
    if word.startswith(BUILT):
        return f"++{word}"
    if not (CONFIG_FOLDER / group).is_dir() or parsed.is_delete():
        return word
    value: Any = parsed.value()
    values = value.list if parsed.is_choice_sweep() else [value]
    if any(value is None or isinstance(value, int | float) for value in values):
        raise ConfigError(f"{word}: names no file; choose one of: {', '.join(available(group))}")
    return word.lstrip("+")


def settings_name(overrides: ListConfig) -> str:
    """Returns the part of a run's folder in a sweep that names the settings given on the command.

    It depends neither on their order nor on what else is in the sweep. A name that was cut, or that
    has characters which a folder cannot have, ends in a digest of the whole.

    Example:
        >>> settings_name(OmegaConf.create(["method=plr", "seed=1", "scale=quick", "x.y=8"]))
        'scale=quick,x.y=8'
    """
    given: Any = OmegaConf.to_container(overrides)
    words = [word.lstrip("+") for word in given]
    named = [word for word in words if re.split(r"[.=]", word)[0] not in UNNAMED]
    whole = ",".join(sorted(named))
    name = re.sub(r"[^\w.=,+~-]", "-", whole)[:LONGEST]
    digest = hashlib.sha256(whole.encode()).hexdigest()[:8]
    return name if name == whole else f"{name}-{digest}"


# ${joined:${seeds}} in the configuration is 0, or 0-1-2 where seeds are trained side by side.
OmegaConf.register_new_resolver(
    "joined",
    # A value that is no list is refused later, in a line that names its key.
    lambda items: "-".join(map(str, items)) if isinstance(items, ListConfig) else str(items),
    replace=True,
)
OmegaConf.register_new_resolver(
    "settings",
    lambda overrides: f"{name}_" if (name := settings_name(overrides)) else "",
    replace=True,
)


def check_scale(overrides: Sequence[str]) -> None:
    """Refuses a scale, which is of the default task, for another task of ``conf/``."""
    said = dict(override.lstrip("+").split("=", 1) for override in overrides if "=" in override)
    task, scale = said.get("task"), said.get("scale")
    if task in available("task") and scale in available("scale"):
        defaults = OmegaConf.load(CONFIG_FOLDER / "train.yaml").defaults
        scaled = next(group.task for group in defaults if "task" in group)
        if task != scaled:
            raise ConfigError(
                f"scale={scale}: is a scale of task={scaled}; task={task} has sizes of its own"
            )


def check_chosen(config: DictConfig, hydra: Any) -> None:
    """Refuses a run without a method, and a file that Hydra has put below its group.

    Hydra puts it there where the first line of a user's file is missing.
    """
    for group, name in hydra.runtime.choices.items():
        below = config.get(group)
        if isinstance(below, DictConfig) and group in below:
            raise ConfigError(
                f"{group}={name}: the first line of {group}/{name}.yaml must be '# @package "
                "_global_', with no byte-order mark before it"
            )
    if config.method is None or config.curriculum is None:
        known = ", ".join(available("method"))
        raise ConfigError(f"method: missing; choose one with +method=NAME, NAME one of: {known}")
