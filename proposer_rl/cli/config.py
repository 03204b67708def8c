"""From Hydra's composed configuration to checked settings, with one-line errors."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from proposer_rl.experiment import Schedule
from proposer_rl.mazes import LevelDistribution, SpecificationSpace
from proposer_rl.mazes.task import (
    DistributionSettings,
    EvaluationSettings,
    MazeSettings,
    SolverSettings,
    SpaceSettings,
)
from proposer_rl.methods import ProposerSettings
from proposer_rl.runs.folder import storage

PACKAGE = Path(__file__).resolve().parents[1]
# In a wheel the configuration lies in the package, in a checkout beside it.
CONFIG_FOLDER = next(
    (folder for folder in (PACKAGE / "conf", PACKAGE.parent / "conf") if folder.is_dir()),
    PACKAGE / "conf",
)


# ${joined:${seeds}} in the configuration: 0, or 0-1-2 where seeds are trained together.
OmegaConf.register_new_resolver(
    "joined", lambda items: "-".join(str(item) for item in items), replace=True
)

# No number in use comes near; beyond it are typing errors, and what machine integers cannot hold.
LARGEST = 10**9
LARGEST_GRID = 10**6
LARGEST_FILE = 10**6


class ConfigError(ValueError):
    """The configuration is wrong; the message is one line."""


class LoggerSettings(BaseModel):
    """Where rows of metrics go besides the run's folder."""

    model_config = ConfigDict(extra="forbid")

    type: Literal["csv", "tensorboard", "wandb"]
    project: str = "proposer_rl"
    mode: Literal["online", "offline", "disabled"] = "online"


class RunConfig(BaseModel):
    """Every setting of a run; names and meaning as in ``conf/train.yaml``."""

    model_config = ConfigDict(extra="forbid")

    method: str
    scale: str
    ablation: str
    curriculum: dict[str, Any]
    lifetimes: Annotated[int, Field(ge=1, le=LARGEST)]
    checkpoint: str | None
    seed: Annotated[int, Field(ge=0)]
    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)] = Field(
        default_factory=lambda known: [known["seed"]]
    )
    device: str
    precision: Literal["auto", "fp32", "bf16"]
    graphs: bool
    threads: Annotated[int, Field(ge=1, le=1024)] | None
    cores: Annotated[int, Field(ge=1, le=1024)] | None
    collector: Literal["single", "multiprocess", "ray"]
    workers: Annotated[int, Field(ge=1, le=LARGEST)] | None
    worker_devices: Annotated[list[str], Field(min_length=1)] | None
    ray_address: str | None
    progress: bool
    maze: MazeSettings
    distributions: dict[str, DistributionSettings]
    target: str
    hand_made_until: list[Annotated[int, Field(ge=1)]]
    space: SpaceSettings
    solver: SolverSettings
    proposer: ProposerSettings
    schedule: Schedule
    evaluation: EvaluationSettings
    logger: LoggerSettings

    @model_validator(mode="after")
    def _agree(self) -> RunConfig:
        proposer, schedule, solver = self.proposer, self.schedule, self.solver
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds={self.seeds}: must be distinct")
        known, measured = sorted(self.distributions), self.evaluation.distributions
        for key, names in (("target", [self.target]), ("evaluation.distributions", measured)):
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(f"{key}: must be among {known}, got {unknown[0]!r}")
        policies = ("success", "greedy_success", "return", "greedy_return")
        headlines = [f"{name}_{policy}" for name in measured for policy in policies]
        if schedule.headline not in headlines:
            raise ValueError(f"schedule.headline={schedule.headline!r}: must be one of {headlines}")
        if proposer.advance != "train" and schedule.cycle_length != proposer.lookahead:
            raise ValueError(
                f"schedule.cycle_length={schedule.cycle_length} must equal proposer.lookahead="
                f"{proposer.lookahead} where proposer.advance={proposer.advance}"
            )
        if proposer.lookahead % proposer.updates_per_step:
            raise ValueError(
                f"proposer.updates_per_step={proposer.updates_per_step} must divide "
                f"proposer.lookahead={proposer.lookahead}"
            )
        if proposer.advantage == "copies" and proposer.rollouts < 2:
            raise ValueError(
                f"proposer.rollouts={proposer.rollouts} must be at least 2 where "
                "proposer.advantage=copies"
            )
        if proposer.ppo.horizon != proposer.lookahead:
            raise ValueError(
                f"proposer.ppo.horizon={proposer.ppo.horizon} must equal proposer.lookahead="
                f"{proposer.lookahead}"
            )
        self._check_workers()
        uneven = [width for width in solver.channels if width % solver.groups]
        if uneven:
            raise ValueError(
                f"solver.channels={solver.channels} must be multiples of solver.groups="
                f"{solver.groups}"
            )
        if proposer.probe_levels > proposer.validation_levels:
            raise ValueError(
                f"proposer.probe_levels={proposer.probe_levels} must be at most "
                f"proposer.validation_levels={proposer.validation_levels}: the Proposer is shown "
                "no more than it is paid for"
            )
        longest = max(length for _, length in self.distributions[self.target].specifications)
        if longest > self.maze.max_steps:
            raise ValueError(
                f"maze.max_steps={self.maze.max_steps} must be at least {longest}, the path length "
                f"of distributions.{self.target}, which is the target"
            )
        smallest = min(self.maze.height, self.maze.width) >> (len(solver.channels) - 1)
        if smallest < 1:
            raise ValueError(
                f"solver.channels={solver.channels} halve a {self.maze.height}x{self.maze.width} "
                "maze to nothing; give fewer channels or a larger maze"
            )
        for halvings, width in enumerate(solver.channels):
            cells = (self.maze.height >> halvings) * (self.maze.width >> halvings)
            if cells * width == solver.groups:
                raise ValueError(
                    f"solver.channels={solver.channels} leave a group of {width} channels with a "
                    f"single number on a {self.maze.height}x{self.maze.width} maze: give more "
                    f"channels, a larger maze or fewer than solver.groups={solver.groups}"
                )
        if self.maze.height * self.maze.width > LARGEST_GRID:
            raise ValueError(
                f"maze.height={self.maze.height}, maze.width={self.maze.width}: must be at most "
                f"{LARGEST_GRID:,} cells together"
            )
        self._check_levels()
        return self

    def _check_workers(self) -> None:
        """Refuse settings of workers that there are not, or that would have nothing to do."""
        for key in ("workers", "worker_devices"):
            if self.collector == "single" and getattr(self, key) is not None:
                raise ValueError(
                    f"{key}={getattr(self, key)}: there are workers only with "
                    "collector=multiprocess or collector=ray"
                )
        if self.collector != "ray" and self.ray_address is not None:
            raise ValueError(f"ray_address={self.ray_address}: is of use only with collector=ray")
        if self.workers is not None and self.workers > self.proposer.rollouts:
            raise ValueError(
                f"workers={self.workers} must be at most proposer.rollouts="
                f"{self.proposer.rollouts}, the copies that they share"
            )

    def _check_levels(self) -> None:
        """Refuse levels that cannot be made, naming the key that asks for them."""
        grid = (self.maze.height, self.maze.width)
        space = self.space
        makers: dict[str, Callable[[], object]] = {
            f"distributions.{name}": partial(
                LevelDistribution, wanted.specifications, wanted.mechanism, *grid
            )
            for name, wanted in self.distributions.items()
        }
        makers["space"] = partial(
            SpecificationSpace,
            space.obstacle_fractions,
            space.path_lengths,
            space.mechanism,
            *grid,
        )
        for key, make in makers.items():
            try:
                make()
            except ValueError as error:
                raise ValueError(f"{key}: {error}") from error


def read_config(config: DictConfig) -> RunConfig:
    """Check a composed configuration.

    Raises:
        ConfigError: naming the first wrong key, its value and what is allowed.
    """
    if config.method is None or config.curriculum is None:
        names = ", ".join(methods())
        raise ConfigError(f"method: missing; choose one with +method=NAME, NAME one of: {names}")
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    for key, value in _leaves(values):
        if isinstance(value, int | float) and abs(value) > LARGEST:
            raise ConfigError(f"{key}={value!r}: must be finite and at most {LARGEST:,} in size")
    try:
        # As JSON, pydantic can be strict: true is no number, "3" neither, but a list is a tuple.
        return RunConfig.model_validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        raise ConfigError(_first_line(error, values)) from error
    except TypeError as error:
        raise ConfigError(
            f"a value that is neither text, number, list nor mapping: {error}"
        ) from error


def saved_config(folder: Path) -> RunConfig:
    """The settings of the run in a folder; what may differ between its calls is left to choice.

    Raises:
        ConfigError: if the folder is no run's, or was written by another version.
    """
    file = folder / "config.json"
    free: dict[str, Any] = {
        "device": "auto",
        "graphs": True,
        "threads": 1,
        "cores": None,
        "collector": "single",
        "workers": None,
        "worker_devices": None,
        "ray_address": None,
        "progress": False,
        "logger": {"type": "csv"},
    }
    if not file.is_file():
        raise ConfigError(f"{folder}: is no run's folder: it has no config.json")
    values = stored_config(file)
    try:
        values["schedule"]["updates"] = 1
        return RunConfig.model_validate_json(json.dumps({**values, **free}), strict=True)
    except ValidationError as error:
        raise ConfigError(f"{file}: {_first_line(error, values)}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{file}: does not hold the settings of a run") from error


def stored_config(file: Path) -> Any:
    """The settings in a run's folder, as they stand there: nothing that they name is made.

    Args:
        file: the folder's ``config.json``.

    Raises:
        ConfigError: if it is no JSON, or far too large to be settings.
        StorageError: if it cannot be read.
    """
    with storage(file, "read"), open(file, "rb") as opened:
        content = opened.read(LARGEST_FILE + 1)
    try:
        return json.loads(content[:LARGEST_FILE])
    except (ValueError, RecursionError):
        raise ConfigError(f"{file}: is no JSON of at most {LARGEST_FILE:,} bytes") from None


def check_order(overrides: Sequence[str]) -> None:
    """Refuse an order in which a scale would undo an ablation: later groups win.

    Args:
        overrides: as given on the command line.

    Raises:
        ConfigError: if ``+scale=`` comes after ``+ablation=``.
    """
    groups = [override.partition("=")[0] for override in overrides]
    if "+ablation" in groups and "+scale" in groups[groups.index("+ablation") :]:
        raise ConfigError("+scale: must come before +ablation, or it would undo the ablation")


def methods() -> list[str]:
    """Names of the methods in the configuration folder."""
    return sorted(file.stem for file in (CONFIG_FOLDER / "method").glob("*.yaml"))


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Every value that is no mapping or list, with its dotted key."""
    if isinstance(value, dict | list):
        for part, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{key}.{part}" if key else str(part))
    else:
        yield key, value


def _first_line(error: ValidationError, values: Mapping[str, Any]) -> str:
    details = error.errors()[0]
    *folder, last = details["loc"] or [""]
    key = ".".join(map(str, details["loc"]))
    message = details["msg"].removeprefix("Value error, ")
    if not key:
        return message
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
