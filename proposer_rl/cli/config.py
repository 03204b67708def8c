"""From Hydra's composed configuration to checked settings, with one-line errors."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, Len
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from proposer_rl.cli.errors import ConfigError, settings_file
from proposer_rl.experiment import ScheduleSettings
from proposer_rl.learning import SolverSettings
from proposer_rl.meta.assembly import ProposerSettings
from proposer_rl.methods import CANNOT_BE_CALLED, completed
from proposer_rl.recipes import maker
from proposer_rl.runs.folder import storage
from proposer_rl.settings import arguments, settings, within

# What a task's maker is given beside the task's own settings.
GIVEN_TO_TASKS = ("solver", "context")


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
    """Checks a composed configuration and returns it as settings, with all defaults."""
    if isinstance(config.get("task"), DictConfig) and "_target_" not in config.task:
        maker("task", {})  # before interpolations find less than what a task brings
    try:
        values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        missing = isinstance(error, MissingMandatoryValue)
        reason = "missing" if missing else str(error).splitlines()[0]
        raise ConfigError(f"{error.full_key}: {reason}") from error
    values = completed(values)
    if isinstance(values.get("task"), dict):  # before what is made of its values elsewhere
        task_maker(values["task"])
    read = RunConfig(**arguments(RunConfig, values))
    if read.checkpoint is not None and read.checkpoint not in read.curriculum.values():
        raise ConfigError(
            f"checkpoint={read.checkpoint}: method={read.method} takes none; "
            "those with a Proposer do, and a run goes on with hydra.run.dir=FOLDER"
        )
    if len(set(read.seeds)) < len(read.seeds):
        raise ConfigError(f"seeds={read.seeds}: must be distinct")
    until = read.curriculum.get("until")
    ends = [end for end in until if isinstance(end, int)] if isinstance(until, list) else []
    if max(ends, default=0) >= read.schedule.updates:
        warnings.warn(
            f"curriculum.until={until}: the last stage never begins, since the run ends after "
            f"{read.schedule.updates} updates",
            stacklevel=2,
        )
    return read


def task_maker(values: Mapping[str, Any]) -> partial[Any]:
    """Returns a function that makes the task of these settings from ``solver`` and ``context``."""
    make, own = maker("task", values)
    lead = f"task._target_={values['_target_']}: "
    with within("task", *CANNOT_BE_CALLED, lead=lead):
        return partial(make, **arguments(make, own, GIVEN_TO_TASKS))


def saved_config(folder: Path) -> RunConfig:
    """Returns the settings of the run in a folder; where it is computed is left to choice."""
    file = settings_file(folder)
    return checked_config(stored_config(file), file)


def checked_config(values: Mapping[str, Any], file: Path) -> RunConfig:
    """Returns settings as a run stored them; where it is computed is left to choice."""
    free = {"compute": {"threads": 1, "progress": False}, "logger": {"type": "csv"}}
    try:
        return RunConfig(**arguments(RunConfig, {**values, **free}))
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
