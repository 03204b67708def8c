"""A command that is refused leaves no folder behind.

Hydra makes a run's folder, or a sweep's, before anything here can look at the settings.
"""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

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


def folder() -> Path | None:
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
