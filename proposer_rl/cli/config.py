"""From Hydra's composed configuration to checked settings, with one-line errors."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Len
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from proposer_rl.cli.errors import ConfigError, one_line
from proposer_rl.cli.settings import (
    ComputeSettings,
    HandDesignedSettings,
    LoggerSettings,
    PoolSettings,
)
from proposer_rl.experiment import ScheduleSettings
from proposer_rl.learning.settings import SolverSettings
from proposer_rl.meta.settings import ProposerSettings
from proposer_rl.runs.folder import read_bounded
from proposer_rl.settings import ArgumentError, arguments, settings

# No number in use comes near; beyond it are typing errors, and what machine integers cannot hold.
LARGEST = 10**9
LARGEST_FILE = 10**6
# What a task's maker is given beside the task's own settings.
GIVEN_TO_TASKS = ("solver", "context")


@settings
class RunConfig:
    """Every setting of a run; names and meaning as in ``conf/train.yaml``.

    What joins several settings is checked where the object is built that needs it.
    """

    method: str
    scale: str
    ablation: str
    curriculum: dict[str, Any]
    filter: dict[str, Any] | None
    model: dict[str, Any] | None
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
    """Check a composed configuration."""
    if isinstance(config.task, DictConfig) and "_target_" not in config.task:
        raise ConfigError(
            "task._target_: missing: the class that makes the task; a file of one's own has it "
            "from another, such as by `defaults: [gymnasium, _self_]`"
        )
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
    """What makes the task of these settings, given ``solver`` and ``context``."""
    return _maker("task", values, lambda _: GIVEN_TO_TASKS)


def curriculum_maker(values: Mapping[str, Any]) -> partial[Any]:
    """What makes the curriculum of these settings, given its parts as the first argument."""
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
    """The settings of the run in a folder; where it is computed is left to choice."""
    file = folder / "config.json"
    if not file.is_file():
        raise ConfigError(f"{folder}: is no run's folder: it has no config.json")
    return checked_config(stored_config(file), file)


def checked_config(values: Mapping[str, Any], file: Path) -> RunConfig:
    """Settings as a run stored them; where it is computed is left to choice."""
    free = {"compute": {"threads": 1, "progress": False}, "logger": {"type": "csv"}}
    try:
        return _checked({**values, **free})
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        raise ConfigError(
            f"{file}: does not hold the settings of a run of this version: {error}"
        ) from error


def stored_config(file: Path) -> Any:
    """The settings in a run's ``config.json`` as they stand there, of which nothing is made."""
    try:
        return json.loads(read_bounded(file, LARGEST_FILE))
    except (ValueError, RecursionError):
        raise ConfigError(f"{file}: is no JSON of at most {LARGEST_FILE:,} bytes") from None


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
    """Plain values, with what they refer to put in its place."""
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
