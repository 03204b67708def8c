"""From Hydra's composed configuration to checked settings, with one-line errors."""

from __future__ import annotations

import inspect
import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, Len
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from proposer_rl.cli.errors import ConfigError, one_line, settings_file
from proposer_rl.experiment import ScheduleSettings
from proposer_rl.extras import where_to_look
from proposer_rl.learning import SolverSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.runs.folder import storage
from proposer_rl.settings import ArgumentError, arguments, settings

# No number in use comes near; beyond it are typing errors, and what machine integers cannot hold.
LARGEST = 10**9
# What a task's maker is given beside the task's own settings.
GIVEN_TO_TASKS = ("solver", "context")
# Bad input, and what is said of annotations that name nothing.
CANNOT_BE_CALLED = (ValueError, TypeError, NameError)


@contextmanager
def key(
    name: str, other: str = "", kinds: tuple[type[Exception], ...] = (ValueError,)
) -> Iterator[None]:
    """Prefixes errors on arguments with the key of the configuration that they stand below.

    Args:
        name: the key.
        other: what comes before any other error of these kinds.
        kinds: that mean bad input.
    """
    try:
        yield
    except ConfigError:
        raise
    except kinds as error:
        lead = f"{name}." if isinstance(error, ArgumentError) else other
        raise ConfigError(f"{lead}{one_line(error)}") from error


@settings
class HandDesignedSettings:
    """A hand-designed curriculum.

    Attributes:
        distributions: of the task, in order.
        until: updates after which each but the last ends.
    """

    distributions: list[str]
    until: list[Annotated[int, Ge(1)]]


@settings
class PoolSettings:
    """Settings of curricula that keep levels: how many, and among how many they choose.

    Attributes:
        capacity: levels of a buffer.
        candidates: levels that are scored to keep some of them.
        keep: of the candidates.
        simplest: values of the space's axes with the easiest bins; None for all bins.
    """

    capacity: Annotated[int, Ge(1)]
    candidates: Annotated[int, Ge(1)]
    keep: Annotated[int, Ge(1)]
    simplest: dict[str, list[float]] | None = None


@settings
class LoggerSettings:
    """Settings of the logger that gets rows of metrics besides the run's folder.

    Attributes:
        type: ``csv`` for nowhere.
        project, mode: of Weights & Biases; None for what its own variables say, WANDB_PROJECT and
            WANDB_MODE, or else ``proposer_rl`` and ``online``.
    """

    type: Literal["csv", "tensorboard", "wandb"]
    project: str | None = None
    mode: Literal["online", "offline", "disabled"] | None = None


@settings
class ComputeSettings:
    """Settings of where a run is computed, which change no numbers beyond rounding.

    Attributes:
        device: ``auto``: cuda where there is one, else cpu.
        graphs: replay on a GPU what can be recorded as CUDA graphs.
        compile: have torch.compile fuse gradient steps, on a GPU.
        threads: CPU threads of one operation; None leaves torch's choice.
        cores: replicas of the Solver computed at once on a CPU; None for all cores.
        collector: where a Proposer's copies are trained: in this process, in several, or by Ray.
        workers: processes for them; None for one for each GPU, or core, at most one for each copy.
        worker_devices: of the workers, in turn; None for all GPUs, or the CPU.
        ray_address: of a Ray cluster, such as auto or 10.0.0.1:6379; None for one on this machine.
        progress: draw progress bars.
    """

    device: str = "auto"
    graphs: bool = True
    compile: bool = False
    threads: Annotated[int, Ge(1), Le(1024)] | None = None
    cores: Annotated[int, Ge(1), Le(1024)] | None = None
    collector: Literal["single", "multiprocess", "ray"] = "single"
    workers: Annotated[int, Ge(1)] | None = None
    worker_devices: Annotated[list[str], Len(1)] | None = None
    ray_address: str | None = None
    progress: bool = True


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
    schedule: ScheduleSettings  # others refer to it
    hand_designed: HandDesignedSettings
    pool: PoolSettings
    solver: SolverSettings
    proposer: ProposerSettings
    compute: ComputeSettings
    logger: LoggerSettings


def read_config(config: DictConfig) -> RunConfig:
    """Checks a composed configuration and returns it as settings."""
    if isinstance(config.task, DictConfig) and "_target_" not in config.task:
        located("task", {})  # before interpolations find less than what a task brings
    values = _resolved(config)
    for name, value in _leaves(values):
        if isinstance(value, int | float) and not abs(value) <= LARGEST:
            raise ConfigError(f"{name}={value!r}: must be finite and at most {LARGEST:,} in size")
    if isinstance(values["task"], dict):  # before what is made of its values elsewhere
        task_maker(values["task"])
    checked = _settings(values)
    read = (value for _, value in _leaves(checked.curriculum))
    if checked.checkpoint is not None and checked.checkpoint not in read:
        raise ConfigError(
            f"checkpoint={checked.checkpoint}: method={checked.method} takes none; "
            "those with a Proposer do, and a run goes on with hydra.run.dir=FOLDER"
        )
    if len(set(checked.seeds)) < len(checked.seeds):
        raise ConfigError(f"seeds={checked.seeds}: must be distinct")
    until = checked.curriculum.get("until")
    ends = [end for end in until if isinstance(end, int)] if isinstance(until, list) else []
    if max(ends, default=0) >= checked.schedule.updates:
        warnings.warn(
            f"curriculum.until={until}: the last stage never begins, since the run ends after "
            f"{checked.schedule.updates} updates",
            stacklevel=2,
        )
    return checked


def task_maker(values: Mapping[str, Any]) -> partial[Any]:
    """Returns a function that makes the task of these settings from ``solver`` and ``context``."""
    target = f"task._target_={values.get('_target_')}"
    make, own = located("task", values)
    with key("task", f"{target}: ", CANNOT_BE_CALLED):
        return partial(make, **arguments(make, own, GIVEN_TO_TASKS))


def located(name: str, values: Mapping[str, Any]) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Returns what ``_target_`` names, and the other settings, some of which are made by Hydra."""
    target = values.get("_target_")
    if not isinstance(target, str):
        raise ConfigError(
            f"{name}._target_: missing: the class or function that makes the {name}; a file of "
            "your own has it from another, such as by `defaults: [gymnasium, _self_]`"
        )
    try:
        made = instantiate({**values, "_partial_": True}, _convert_="all")
        inspect.signature(made.func)
    except (HydraException, ImportError, AttributeError, TypeError, ValueError) as error:
        cause: BaseException = error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        raise ConfigError(f"{name}: {one_line(cause)}{where_to_look(cause)}") from error
    return made.func, made.keywords


def saved_config(folder: Path) -> RunConfig:
    """Returns the settings of the run in a folder; where it is computed is left to choice."""
    file = settings_file(folder)
    return checked_config(stored_config(file), file)


def checked_config(values: Mapping[str, Any], file: Path) -> RunConfig:
    """Returns settings as a run stored them; where it is computed is left to choice."""
    free = {"compute": {"threads": 1, "progress": False}, "logger": {"type": "csv"}}
    try:
        return _settings({**values, **free})
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        raise ConfigError(
            f"{file}: does not hold the settings of a run of this version: {error}"
        ) from error


def stored_config(file: Path) -> Any:
    """Returns the content of a run's ``config.json`` unchecked."""
    try:
        with storage(file, "read"):
            return json.loads(file.read_bytes())
    except (ValueError, RecursionError):
        raise ConfigError(f"{file}: is no JSON") from None


def _resolved(config: DictConfig) -> Any:
    """Returns plain values, with references replaced by what they refer to."""
    try:
        return OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        missing = isinstance(error, MissingMandatoryValue)
        reason = "missing" if missing else str(error).splitlines()[0]
        raise ConfigError(f"{error.full_key}: {reason}") from error


def _settings(values: Mapping[str, Any]) -> RunConfig:
    return RunConfig(**arguments(RunConfig, values))


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yields every value that is no mapping or list, with its dotted key."""
    if isinstance(value, dict | list):
        for part, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{name}.{part}" if name else str(part))
    else:
        yield name, value
