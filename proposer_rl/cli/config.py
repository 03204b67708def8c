"""From Hydra's composed configuration to checked settings, with one-line errors."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from proposer_rl.cli.errors import one_line
from proposer_rl.cli.places import CHANGING, CONFIG_FOLDER, names
from proposer_rl.runs.folder import read_bounded
from proposer_rl.settings import (
    ComputeSettings,
    FilterSettings,
    HandDesignedSettings,
    LoggerSettings,
    PoolSettings,
    ProposerSettings,
    Schedule,
    SolverSettings,
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
GIVEN_TO_TASKS = ("solver", "place")


class ConfigError(ValueError):
    """The configuration is wrong; the message is one line."""

    exit_code = 2


class RunConfig(BaseModel):
    """Every setting of a run; names and meaning as in ``conf/train.yaml``.

    What joins several settings is checked where the object is built that needs it.
    """

    model_config = ConfigDict(extra="forbid")

    method: str
    scale: str
    ablation: str
    curriculum: dict[str, Any]
    filter: FilterSettings | None
    task: dict[str, Any]
    lifetimes: Annotated[int, Field(ge=1, le=LARGEST)]
    checkpoint: str | None
    seed: Annotated[int, Field(ge=0)]
    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]
    precision: Literal["auto", "fp32", "bf16"]
    hand_designed: HandDesignedSettings
    pool: PoolSettings
    solver: SolverSettings
    proposer: ProposerSettings
    schedule: Schedule
    compute: ComputeSettings
    logger: LoggerSettings


@dataclass(frozen=True)
class TaskMaker:
    """What makes a run's task: its target, and the settings it is called with."""

    make: Callable[..., Any]
    settings: Mapping[str, Any]


def read_config(config: DictConfig) -> RunConfig:
    """Check a composed configuration.

    Raises:
        ConfigError: naming the first wrong key, its value and what is allowed.
    """
    if config.method is None or config.curriculum is None:
        known = ", ".join(methods())
        raise ConfigError(f"method: missing; choose one with +method=NAME, NAME one of: {known}")
    values = _resolved(config)
    for key, value in _leaves(values):
        if isinstance(value, int | float) and abs(value) > LARGEST:
            raise ConfigError(f"{key}={value!r}: must be finite and at most {LARGEST:,} in size")
    if isinstance(values["task"], dict):  # before what is made of its values elsewhere
        task_maker(values["task"])
    checked = _validated(RunConfig, values)
    read = (value for _, value in _leaves(checked.curriculum))
    if checked.checkpoint is not None and checked.checkpoint not in read:
        raise ConfigError(
            f"checkpoint={checked.checkpoint}: method={checked.method} takes none; "
            "those with a Proposer do, and a run goes on with hydra.run.dir=FOLDER"
        )
    if len(set(checked.seeds)) < len(checked.seeds):
        raise ConfigError(f"seeds={checked.seeds}: must be distinct")
    return checked


def task_maker(settings: Mapping[str, Any]) -> TaskMaker:
    """What makes the task, with its settings checked against the types that its maker asks for.

    Args:
        settings: ``task`` of the configuration.

    Raises:
        ConfigError: if there is no such maker, naming the first wrong key.
    """
    values = dict(settings)
    target = values.pop("_target_", None)
    if not isinstance(target, str):
        raise ConfigError("task._target_: missing: the class or function that makes the task")
    try:
        make = instantiate({"_target_": target, "_partial_": True}).func
        parameters = inspect.signature(make).parameters
        typed = make.__init__ if inspect.isclass(make) else make
        hints = get_type_hints(typed, include_extras=True)  # bounds, too
    except (HydraException, ImportError, AttributeError, TypeError, ValueError, NameError) as error:
        raise ConfigError(f"task._target_={target}: {why_not_made(error)}") from error
    missing = [name for name in GIVEN_TO_TASKS if name not in parameters]
    if missing:
        raise ConfigError(
            f"task._target_={target}: makes no task: it takes no argument {missing[0]!r}"
        )
    fields: dict[str, Any] = {
        name: (
            hints.get(name, Any),
            ... if parameter.default is parameter.empty else parameter.default,
        )
        for name, parameter in parameters.items()
        if name not in GIVEN_TO_TASKS
    }
    model = create_model("Task", __config__=ConfigDict(extra="forbid"), **fields)
    checked = _validated(model, values, "task.")
    return TaskMaker(make, {name: getattr(checked, name) for name in fields})


def saved_config(folder: Path) -> RunConfig:
    """The settings of the run in a folder; where it is computed is left to choice.

    Raises:
        ConfigError: if the folder is no run's, or was written by another version.
    """
    file = folder / "config.json"
    if not file.is_file():
        raise ConfigError(f"{folder}: is no run's folder: it has no config.json")
    values = stored_config(file)
    free = {"compute": {"threads": 1, "progress": False}, "logger": {"type": "csv"}}
    try:
        return _validated(RunConfig, {**values, **free})
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: does not hold the settings of a run: {error}") from error


def stored_config(file: Path) -> Any:
    """The settings in a run's folder, as they stand there: nothing that they name is made.

    Args:
        file: the folder's ``config.json``.

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

    Args:
        given: overrides as they stand on the command line.

    Raises:
        ConfigError: if ``+method=`` or ``+scale=`` comes after a group that changes them, or a
            scale of ours is of another of our tasks.
    """
    said = dict(override.split("=", 1) for override in given if "=" in override)
    task, scale = said.get("task"), said.get("+scale")
    if task in names(CONFIG_FOLDER, "task") and scale in names(CONFIG_FOLDER, "scale"):
        defaults: Any = OmegaConf.load(CONFIG_FOLDER / "train.yaml").defaults
        scaled = next(group["task"] for group in defaults if "task" in group)
        if task != scaled:
            raise ConfigError(
                f"+scale={scale}: is of task={scaled}; task={task} has numbers of its own"
            )
    changed_by = None
    for override in given:
        group = override.partition("=")[0]
        if group in CHANGING:
            changed_by = changed_by or group
        elif group in ("+method", "+scale") and changed_by is not None:
            raise ConfigError(f"{group}: must come before {changed_by}, or it would undo it")


def methods() -> list[str]:
    """Names of the methods in the configuration folder."""
    return names(CONFIG_FOLDER, "method")


def why_not_made(error: BaseException, called: str = "") -> str:
    """One line on a ``_target_`` that cannot be had; of an import that fails, why it does.

    Args:
        error: what happened.
        called: the command's own name of what refuses a setting; its function's by default.
    """
    line = one_line(error).partition(", set env var HYDRA_FULL_ERROR")[0]
    unknown = re.fullmatch(r"(\w+)\S*\(\) got an unexpected keyword argument (\S+)", line)
    if unknown:
        return f"{called or unknown[1]} has no setting {unknown[2]}"
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
        # Its key; where a value is missing, that one rather than those that refer to it.
        leaves = _leaves(OmegaConf.to_container(config))
        for key, value in sorted(leaves, key=lambda leaf: leaf[1] != "???"):
            try:
                OmegaConf.select(config, key, throw_on_missing=True)
            except OmegaConfBaseException as found:
                reason = "missing" if value == "???" else str(found).splitlines()[0]
                raise ConfigError(f"{key}={value}: {reason}") from error
        raise ConfigError(str(error)) from error


def _validated(model: Any, values: Any, prefix: str = "") -> Any:
    try:
        # As JSON, pydantic can be strict: true is no number, "3" neither, but a list is a tuple.
        return model.model_validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        raise ConfigError(_first_line(error, values, prefix)) from error
    except TypeError as error:
        raise ConfigError(
            f"a value that is neither text, number, list nor mapping: {error}"
        ) from error


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Every value that is no mapping or list, with its dotted key."""
    if isinstance(value, dict | list):
        for part, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{key}.{part}" if key else str(part))
    else:
        yield key, value


def _first_line(error: ValidationError, values: Any, prefix: str) -> str:
    errors = error.errors()
    # Of a union pydantic tells what is wrong with every member; one of another kind is not meant.
    others = [e["loc"][:-1] for e in errors if e["loc"][-1:] == ("kind",)]
    meant = [e for e in errors if not any(e["loc"][: len(other)] == other for other in others)]
    details = (meant or errors)[0]
    # A member's name is no key of the configuration.
    loc = [part for part in details["loc"] if not str(part).endswith("Settings")]
    *folder, last = loc or [""]
    key = prefix + ".".join(map(str, loc))
    message = details["msg"].removeprefix("Value error, ")
    if not meant:  # of a kind that there is not: the members' kinds are what there is
        kinds = {str(e["ctx"]["expected"]) for e in errors if e["loc"][-1:] == ("kind",)}
        message = f"input should be one of {', '.join(sorted(kinds))}"
    if details["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        siblings: Any = values
        for part in folder:
            siblings = siblings[part]
        known = ", ".join(sorted(map(str, siblings.keys() - {last})))
        return f"{key}: there is no such key; there are: {known}"
    if details["type"] == "missing":
        return f"{key}: missing"
    given = repr(details["input"])
    given = given if len(given) <= 80 else f"{given[:77]}..."
    return f"{key}={given}: {message[0].lower()}{message[1:]}"
