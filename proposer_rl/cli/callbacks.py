"""What Hydra calls before and after runs: a refused one leaves no folder, a failed one its reason.

Hydra makes a run's folder, or a sweep's, before anything here can look at the settings.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from proposer_rl.cli.errors import UNFORESEEN, exit_code, one_line
from proposer_rl.runs.folder import FAILURE, write_atomically
from proposer_rl.runs.process import InUseError

HYDRAS_OWN = {".hydra", "train.log", "multirun.yaml"}

_folder: Path | None = None
# Folders that were not there when the command began, the innermost first.
_new: list[Path] = []


class Traces(Callback):
    """Notes which folders the command is going to make."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Called by Hydra before it makes a run's folder."""
        _note(config, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Called by Hydra before it makes a sweep's folder."""
        _note(config, "hydra.sweep.dir")


def command_folder() -> Path | None:
    """The folder of the run or sweep; None before the command has come so far."""
    return _folder


def remove_traces() -> None:
    """Remove the folders that the command has made, unless there is more in them than Hydra's."""
    for folder in _new:
        with suppress(OSError):
            if {entry.name for entry in folder.iterdir()} <= HYDRAS_OWN:
                shutil.rmtree(folder)


def _note(config: DictConfig, key: str) -> None:
    global _folder
    _new.clear()
    # A folder's name that cannot be told is refused by Hydra right after this.
    with suppress(OmegaConfBaseException):
        _folder = path = Path(OmegaConf.select(config, key)).absolute()
        _new.extend(folder for folder in (path, *path.parents) if not folder.exists())


class LostJobError(RuntimeError):
    """A job of another machine or process ended without a word of its run; the message is one line.

    The same command goes on with what is left.
    """

    exit_code = 6


def forget_failure(folder: Path) -> None:
    """A run that failed is tried again: what is recorded of the failure no longer holds."""
    (folder / FAILURE).unlink(missing_ok=True)


def record_failure(folder: Path, error: Exception) -> float:
    """Record in a run's folder that it failed, and say so.

    Of a run that another process is working on nothing is recorded: the folder is not ours.

    Returns:
        NaN, for the run's value.
    """
    message, code = one_line(error, folder), exit_code(error)
    if not isinstance(error, InUseError):
        content = {"message": message, "kind": type(error).__name__, "exit_code": code}
        write_atomically(folder / FAILURE, (json.dumps(content, indent=2) + "\n").encode())
    if code == UNFORESEEN:
        traceback.print_exception(error)
    print(f"error: {message}", file=sys.stderr)
    return math.nan
