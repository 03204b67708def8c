"""Sweeps: what is left of one, and runs that fail without taking the others with them."""

from __future__ import annotations

import json
import math
import sys
import traceback
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig
from rich.console import Console

from proposer_rl.report.progress import PLAN, find_progress, left
from proposer_rl.report.reading import FAILURE
from proposer_rl.report.terminal import overview
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.lock import InUseError

LARGEST_PLAN, MOST_RUNS = 2**20, 10_000


class LostJobError(RuntimeError):
    """A job of another machine or process ended without a word of its run; the message is one line.

    The same command goes on with what is left.
    """

    exit_code = 6


class SweepSummary(Callback):
    """Says after each run what is left of a sweep, and lists its runs when it is over.

    The exit code is that of a run that failed in it; other sweeps may have the same folder.
    """

    def __init__(self) -> None:
        self._failed_before: dict[Path, int] = {}

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Called by Hydra before the first run."""
        self._failed_before = _failures(config)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Called by Hydra after every run, of a sweep or not."""
        if config.hydra.mode == RunMode.MULTIRUN:
            folder = Path(config.hydra.sweep.dir)
            rest = left(folder, planned(folder))
            if rest is not None:
                print(rest.text())

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Called by Hydra after the last run, whatever became of the runs."""
        found = find_progress(Path(config.hydra.sweep.dir))
        Console().print(overview(found))
        failed = _failures(config).items() - self._failed_before.items()
        if failed:
            # Hydra turns an exception of a callback into a warning, but lets an exit through.
            sys.exit(max(int(json.loads(file.read_text())["exit_code"]) for file, _ in failed))


def planned(folder: Path) -> list[tuple[str, ...]]:
    """The runs of a sweep, as its folder says: of each the settings.

    Empty where it does not say, or what it says is not understood.
    """
    path = folder / PLAN
    try:
        if path.is_symlink() or path.stat().st_size > LARGEST_PLAN:
            return []
        hydra = yaml.safe_load(path.read_text(encoding="utf-8"))["hydra"]
        swept = [f"{key}={value}" for key, value in (hydra["sweeper"]["params"] or {}).items()]
        overrides = OverridesParser.create().parse_overrides([*swept, *hydra["overrides"]["task"]])
        values = {one.get_key_element(): list(islice(_values(one), MOST_RUNS)) for one in overrides}
    except (OSError, ValueError, LookupError, TypeError, RecursionError, yaml.YAMLError):
        return []
    except HydraException:  # files of a glob are looked for where Hydra composes
        return []
    settings = [[f"{key}={one}" for one in found] for key, found in values.items()]
    return list(product(*settings)) if math.prod(map(len, settings)) < MOST_RUNS else []


def _values(override: Override) -> Iterator[str]:
    if override.is_sweep_override():
        yield from override.sweep_string_iterator()
    else:
        yield override.get_value_element_as_str()


def forget_failure(folder: Path) -> None:
    """A run that failed is tried again: what is recorded of the failure no longer holds."""
    (folder / FAILURE).unlink(missing_ok=True)


def record_failure(folder: Path, error: Exception, message: str, exit_code: int) -> float:
    """Record in a run's folder that it failed, and say so.

    Of a run that another process is working on nothing is recorded: the folder is not ours.

    Returns:
        NaN, for the run's value.
    """
    if not isinstance(error, InUseError):
        content = {"message": message, "kind": type(error).__name__, "exit_code": exit_code}
        write_atomically(folder / FAILURE, (json.dumps(content, indent=2) + "\n").encode())
    if exit_code == 1:
        traceback.print_exception(error)
    print(f"error: {message}", file=sys.stderr)
    return math.nan


def _failures(config: DictConfig) -> dict[Path, int]:
    """What is recorded of failed runs in a sweep's folder, and when it was written."""
    folder = Path(config.hydra.sweep.dir)
    return {file: file.stat().st_mtime_ns for file in folder.rglob(FAILURE)}
