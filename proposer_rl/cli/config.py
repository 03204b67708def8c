"""Validates the configuration that Hydra has composed, and the one that a run has stored."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, Len
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from proposer_rl.cli.errors import ConfigError, one_line, settings_file
from proposer_rl.experiment import ScheduleSettings
from proposer_rl.learning import SolverSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import INPUT_ERRORS, completed
from proposer_rl.recipes import maker
from proposer_rl.runs.folder import storage
from proposer_rl.settings import arguments, settings, within

# The function that makes a task gets these arguments beside the task's own settings.
GIVEN_TO_TASKS = ("solver", "context")


@settings
class HandDesignedSettings:
    """The stages of a hand-designed curriculum.

    Attributes:
        distributions: names of the task's, in order.
        until: updates after which each but the last ends.
    """

    distributions: list[str]
    until: list[Annotated[int, Ge(1)]]


@settings
class PoolSettings:
    """How many levels curricula keep, and among how many they choose.

    Attributes:
        capacity: of a buffer of levels.
        candidates: levels that are scored at once.
        keep: how many of the candidates are kept.
        simplest: values of the space's axes with the easiest bins; None for all bins.
    """

    capacity: Annotated[int, Ge(1)]
    candidates: Annotated[int, Ge(1)]
    keep: Annotated[int, Ge(1)]
    simplest: dict[str, list[float]] | None = None


@settings
class LoggerSettings:
    """Where metrics are logged besides the run's folder.

    Attributes:
        type: ``csv`` for the run's folder alone.
        project, mode: of Weights & Biases; None for its environment variables WANDB_PROJECT and
            WANDB_MODE, or else ``proposer_rl`` and ``online``.
    """

    type: Literal["csv", "tensorboard", "wandb"]
    project: str | None = None
    mode: Literal["online", "offline", "disabled"] | None = None


@settings
class ComputeSettings:
    """Where and how a run is computed; changes no numbers beyond rounding.

    Attributes:
        device: ``auto`` for cuda where it is available, else cpu.
        graphs: on a GPU, replay updates and evaluations as CUDA graphs.
        compile: on a GPU, fuse gradient steps by torch.compile.
        threads: CPU threads of one operation; None for torch's default.
        cores: replicas of the Solver computed at once on a CPU; None for all cores.
        collector: where a Proposer's replicas are trained: in this process, in several, or by Ray.
        workers: processes for the replicas; None for one for each GPU or core, at most one for each
            replica.
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
    ray_address: str | None = None
    progress: bool = True


@settings
class RunConfig:
    """All settings of a run; names and meaning as in ``conf/train.yaml``.

    Rules that join several settings are checked where the object is built that uses them.
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
    schedule: ScheduleSettings
    hand_designed: HandDesignedSettings
    pool: PoolSettings
    solver: SolverSettings
    proposer: ProposerSettings
    compute: ComputeSettings
    logger: LoggerSettings


def read_config(config: DictConfig) -> RunConfig:
    """Validates a composed configuration and returns it as settings, with all defaults."""
    if isinstance(config.get("task"), DictConfig) and "_target_" not in config.task:
        maker("task", {})  # refuses it, before references to the task's settings cannot be resolved
    try:
        values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise ConfigError(one_line(error)) from error
    values = completed(values)
    if isinstance(values.get("task"), dict):  # first, since other settings refer to its values
        task_maker(values["task"])
    read = RunConfig(**values)
    if read.checkpoint is not None and read.checkpoint not in read.curriculum.values():
        raise ConfigError(
            f"checkpoint={read.checkpoint}: has no effect with method={read.method}, which has no "
            "Proposer; to resume a run, give hydra.run.dir=FOLDER"
        )
    if len(set(read.seeds)) < len(read.seeds):
        raise ConfigError(f"seeds={read.seeds}: must be distinct")
    return read


def task_maker(values: Mapping[str, Any]) -> partial[Any]:
    """Validates a task's settings; returns its function of ``solver`` and ``context``."""
    make, own = maker("task", values)
    lead = f"task._target_={values['_target_']}: "
    with within("task", *INPUT_ERRORS, lead=lead):
        return partial(make, **arguments(make, own, GIVEN_TO_TASKS))


def saved_config(folder: Path) -> RunConfig:
    """Returns the settings of the run in a folder, except where it was computed."""
    file = settings_file(folder)
    return checked_config(stored_config(file), file)


def checked_config(values: Mapping[str, Any], file: Path) -> RunConfig:
    """Returns the settings that a run stored in a file, except where it was computed."""
    free = {"compute": {"threads": 1, "progress": False}, "logger": {"type": "csv"}}
    try:
        return RunConfig(**{**values, **free})
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{file}: not the settings of a run of this version: {error}") from error


def stored_config(file: Path) -> Any:
    """Returns the content of a run's ``config.json``, not validated."""
    try:
        with storage(file, "read"):
            return json.loads(file.read_bytes())
    except ValueError as error:
        raise ConfigError(f"{file}: {error}") from error
