"""From Hydra's composed configuration to checked settings, with one-line errors."""

from __future__ import annotations

import codecs
import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Len
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from proposer_rl.cli.errors import one_line
from proposer_rl.cli.places import CHANGING, CONFIG_FOLDER
from proposer_rl.cli.settings import (
    ComputeSettings,
    HandDesignedSettings,
    LoggerSettings,
    PoolSettings,
)
from proposer_rl.recipes import available
from proposer_rl.runs.folder import read_bounded
from proposer_rl.settings import (
    ArgumentError,
    FilterSettings,
    ModelSettings,
    ProposerSettings,
    ScheduleSettings,
    SolverSettings,
    arguments,
    settings,
)

# ${joined:${seeds}} in the configuration: 0, or 0-1-2 where seeds are trained together.
OmegaConf.register_new_resolver(
    "joined",
    # What is no list is refused later, in a line that names its key.
    lambda items: "-".join(map(str, items)) if isinstance(items, ListConfig) else str(items),
    replace=True,
)

# No number in use comes near; beyond it are typing errors, and what machine integers cannot hold.
LARGEST = 10**9
LARGEST_FILE = 10**6
# What a task's maker is given beside the task's own settings.
GIVEN_TO_TASKS = ("solver", "context")


class ConfigError(ValueError):
    """The configuration is wrong; the message is one line."""

    exit_code = 2


@contextmanager
def key(
    name: str, other: str = "", kinds: tuple[type[Exception], ...] = (ValueError,)
) -> Iterator[None]:
    """Put a key of the configuration before what is said of the arguments that stand below it.

    Args:
        name: the key.
        other: what comes before any other error of these kinds.
        kinds: that mean bad input.

    Raises:
        ConfigError: in place of all of these.
    """
    try:
        yield
    except ConfigError:
        raise
    except kinds as error:
        lead = f"{name}." if isinstance(error, ArgumentError) else other
        raise ConfigError(f"{lead}{one_line(error)}") from error


@settings
class RunConfig:
    """Every setting of a run; names and meaning as in ``conf/train.yaml``.

    What joins several settings is checked where the object is built that needs it.
    """

    method: str
    scale: str
    ablation: str
    curriculum: dict[str, Any]
    filter: FilterSettings | None
    model: ModelSettings | None
    task: dict[str, Any]
    checkpoint: str | None
    seed: Annotated[int, Ge(0)]
    seeds: Annotated[list[Annotated[int, Ge(0)]], Len(1)]
    precision: Literal["auto", "fp32", "bf16"]
    hand_designed: HandDesignedSettings
    pool: PoolSettings
    solver: SolverSettings
    proposer: ProposerSettings
    schedule: ScheduleSettings
    compute: ComputeSettings
    logger: LoggerSettings


def read_config(config: DictConfig) -> RunConfig:
    """Check a composed configuration.

    Raises:
        ConfigError: naming the first wrong key, its value and what is allowed.
    """
    if config.method is None or config.curriculum is None:
        known = ", ".join(methods())
        raise ConfigError(f"method: missing; choose one with +method=NAME, NAME one of: {known}")
    values = _resolved(config)
    for name, value in _leaves(values):
        if isinstance(value, int | float) and not abs(value) <= LARGEST:
            raise ConfigError(f"{name}={value!r}: must be finite and at most {LARGEST:,} in size")
    if isinstance(values["task"], dict):  # before what is made of its values elsewhere
        task_maker(values["task"])
    checked = _checked(values)
    read = (value for _, value in _leaves(checked.curriculum))
    if checked.checkpoint is not None and checked.checkpoint not in read:
        raise ConfigError(
            f"checkpoint={checked.checkpoint}: method={checked.method} takes none; "
            "those with a Proposer do, and a run goes on with hydra.run.dir=FOLDER"
        )
    if len(set(checked.seeds)) < len(checked.seeds):
        raise ConfigError(f"seeds={checked.seeds}: must be distinct")
    return checked


def task_maker(values: Mapping[str, Any]) -> partial[Any]:
    """What makes the task of these settings, given ``solver`` and ``context``.

    Raises:
        ConfigError: if there is no such maker, or a setting is wrong, naming its key.
    """
    return _maker("task", values, lambda _: GIVEN_TO_TASKS)


def curriculum_maker(values: Mapping[str, Any]) -> partial[Any]:
    """What makes the curriculum of these settings, given its parts as the first argument.

    Raises:
        ConfigError: as :func:`task_maker`.
    """
    return _maker("curriculum", values, lambda names: names[:1])


def _maker(
    name: str, values: Mapping[str, Any], given: Callable[[list[str]], Sequence[str]]
) -> partial[Any]:
    """The callable that ``_target_`` names with its arguments, of which some may be made, too."""
    target = values.get("_target_")
    if not isinstance(target, str):
        raise ConfigError(f"{name}._target_: missing: the class or function that makes the {name}")
    try:
        made = instantiate({**values, "_partial_": True}, _convert_="all")
        known = [*inspect.signature(made.func).parameters]
    except (HydraException, ImportError, AttributeError, TypeError, ValueError) as error:
        inner = re.search(r"full_key: (\w+?)\W*\d*\W*$", str(error))  # of a list the place, too
        wrong = f"{name}.{inner[1]}" if inner else f"{name}._target_={target}"
        raise ConfigError(f"{wrong}: {_why_not_found(error)}") from error
    others = given(known)
    for missing in set(others) - set(known):
        raise ConfigError(
            f"{name}._target_={target}: makes no {name}: it takes no argument {missing!r}"
        )
    try:
        return partial(made.func, **arguments(made.func, made.keywords, others))
    except ArgumentError as error:
        raise ConfigError(f"{name}.{error}") from error
    except (NameError, TypeError) as error:  # of annotations that name nothing
        raise ConfigError(f"{name}._target_={target}: {one_line(error)}") from error


def saved_config(folder: Path) -> RunConfig:
    """The settings of the run in a folder; where it is computed is left to choice.

    Raises:
        ConfigError: if the folder is no run's, or was written by another version.
    """
    file = folder / "config.json"
    if not file.is_file():
        raise ConfigError(f"{folder}: is no run's folder: it has no config.json")
    return checked_config(stored_config(file), file)


def checked_config(values: Mapping[str, Any], file: Path) -> RunConfig:
    """Settings as a run stored them; where it is computed is left to choice.

    Raises:
        ConfigError: if they are of another version.
    """
    free = {"compute": {"threads": 1, "progress": False}, "logger": {"type": "csv"}}
    try:
        return _checked({**values, **free})
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        raise ConfigError(
            f"{file}: does not hold the settings of a run of this version: {error}"
        ) from error


def stored_config(file: Path) -> Any:
    """The settings in a run's ``config.json``, as they stand there: nothing that they name is made.

    Raises:
        ConfigError: if it is no JSON, or far too large to be settings.
        StorageError: if it cannot be read.
    """
    try:
        return json.loads(read_bounded(file, LARGEST_FILE))
    except (ValueError, RecursionError):
        raise ConfigError(f"{file}: is no JSON of at most {LARGEST_FILE:,} bytes") from None


def overrides() -> list[str]:
    """As given on the command line: what they refer to is the run's, not Hydra's own."""
    given: Any = OmegaConf.to_container(HydraConfig.get().overrides.task)
    return list(given)


def check_groups(given: Sequence[str]) -> None:
    """Refuse groups of which one would undo another, since later ones win, or that do not fit.

    Raises:
        ConfigError: if ``+method=`` or ``+scale=`` comes after a group that changes them, or a
            scale of ours is of another of our tasks.
    """
    said = dict(override.split("=", 1) for override in given if "=" in override)
    task, scale = said.get("task"), said.get("+scale")
    if task in available("task") and scale in available("scale"):
        defaults: Any = OmegaConf.load(CONFIG_FOLDER / "train.yaml").defaults
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


def check_packages(config: DictConfig) -> None:
    """Refuse a file of one's own that Hydra has put below its group, for want of its first line.

    Raises:
        ConfigError: naming the file.
    """
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


def methods() -> list[str]:
    """Names of the methods in the configuration folder."""
    return available("method")


def _why_not_found(error: BaseException) -> str:
    """One line on a ``_target_`` that cannot be had; of an import that fails, why it does."""
    line = re.split(r", set env var HYDRA_FULL_ERROR|\s*full_key: ", one_line(error))[0]
    innermost = error
    while innermost.__cause__ is not None:
        innermost = innermost.__cause__
    if innermost is error or not isinstance(innermost, ImportError):
        return line
    line = f"{line}: {one_line(innermost)}"
    # With a dot in its name, what holds the module was found.
    if not isinstance(innermost, ModuleNotFoundError) or "." in str(innermost.name):
        return line
    return f"{line}; if it is your own, name its folder, as in PYTHONPATH=. bin/train ..."


def _resolved(config: DictConfig) -> Any:
    """Plain values, with what they refer to put in its place.

    Raises:
        ConfigError: naming a value that is missing or refers to none.
    """
    try:
        return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        missing = isinstance(error, MissingMandatoryValue)
        reason = "missing" if missing else str(error).splitlines()[0]
        raise ConfigError(f"{error.full_key}: {reason}") from error


def _checked(values: Mapping[str, Any]) -> RunConfig:
    try:
        return RunConfig(**arguments(RunConfig, values))
    except ArgumentError as error:
        raise ConfigError(str(error)) from error


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every value that is no mapping or list, with its dotted key."""
    if isinstance(value, dict | list):
        for part, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{name}.{part}" if name else str(part))
    else:
        yield name, value
