"""``bin/train``, but for its help: from the command line to the settings of one or more runs.

What composes them needs no PyTorch, so that a typing error is told at once. Hydra makes a run's
folder, or a sweep's, before anything here can look at the settings: a run that is refused leaves no
folder, one that fails in a sweep leaves its reason.
"""

from __future__ import annotations

import gc
import math
import os
import shutil
import sys
import traceback
from argparse import ArgumentParser
from contextlib import suppress
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from proposer_rl.cli.errors import UNFORESEEN, ConfigError, command, exit_code, one_line, refuse
from proposer_rl.cli.groups import check_chosen, check_groups, explained, overrides
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.folder import FAILURE, RunFolder
from proposer_rl.runs.process import InUseError, StopSignals, guard_output

LONGEST = 300  # characters of what is said of a lost job
HYDRAS_OWN = {".hydra", "train.log", "multirun.yaml"}
BEGUN: list[Path] = []  # folders of this process's runs: what comes after is no matter of overrides
COMMAND: list[Path] = []  # the folder of the run or sweep, once the command has come so far
NEW: list[Path] = []  # folders that were not there when the command began, the innermost first


class LostJobError(RuntimeError):
    """A job of another machine or process ended without a word of its run; the message is one line.

    The same command goes on with what is left.
    """

    exit_code = 6


class Traces(Callback):
    """Notes which folders the command is going to make."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Notes a run's folder, before Hydra makes it."""
        _note(config, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Notes a sweep's folder, before Hydra makes it."""
        _note(config, "hydra.sweep.dir")


def main() -> None:
    """Runs the command; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    # Hydra then lets its errors through, so that they can be told in one line.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    command(_compose_and_run)


def _compose_and_run() -> None:
    _refuse_pickles(sys.argv)
    BEGUN.clear()
    if sys.version_info >= (3, 14):  # it refuses a help text of Hydra's (to 1.3.8), no string
        ArgumentParser._check_help = lambda self, action: None
    try:
        _main()
    except (HydraException, OmegaConfBaseException, UnicodeDecodeError, YAMLError) as error:
        _remove_traces()
        raise ConfigError(explained(error)) from error
    except RuntimeError as error:
        if not type(error).__module__.startswith("submitit."):
            raise
        raise LostJobError(
            f"no job was sent, or it left no result: {one_line(error)[:LONGEST]}"
        ) from error
    except OSError as error:  # of Hydra's own files
        _remove_traces()
        refuse(error, *COMMAND)
    except ValueError as error:
        if BEGUN:
            raise
        _remove_traces()
        if isinstance(error.__cause__, OSError):  # of the file that logging cannot open
            refuse(error.__cause__)
        raise ConfigError(one_line(error)) from error  # of an override such as +method=3


@hydra.main(version_base="1.3", config_path=str(CONFIG_FOLDER), config_name="train")
def _main(hydra_config: DictConfig) -> float:
    guard_output()  # launchers start processes that begin here
    BEGUN.append(path := Path(HydraConfig.get().runtime.output_dir))
    signals = StopSignals()
    try:
        (path / FAILURE).unlink(missing_ok=True)  # a run that failed is tried again
        check_groups(overrides())
        check_chosen(hydra_config)
        with signals:  # already now: amid imports is no place to stop
            from proposer_rl.cli import shown  # only now: it takes seconds
            from proposer_rl.cli.config import read_config
            from proposer_rl.cli.run import train

            return train(read_config(hydra_config), path, signals, shown)
    except Exception as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return _record_failure(path, error)
        if exit_code(error) != UNFORESEEN:
            _remove_traces()
            refuse(error, path)
        raise
    finally:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            # Environments hang in circles and may hold gigabytes that Python does not see, as
            # MuJoCo's models; those of the next run would come on top.
            gc.collect()


def _refuse_pickles(arguments: list[str]) -> None:
    """Refuses --experimental-rerun, with which Hydra reads a pickle, that is, runs code."""
    if any(argument.startswith("--experimental-rerun") for argument in arguments):
        raise ConfigError("--experimental-rerun: not supported; give the run's own arguments again")


def _note(config: DictConfig, key: str) -> None:
    COMMAND.clear()
    NEW.clear()
    # A folder's name that cannot be told is refused by Hydra right after this.
    with suppress(OmegaConfBaseException):
        path = Path(OmegaConf.select(config, key)).absolute()
        COMMAND.append(path)
        NEW.extend(folder for folder in (path, *path.parents) if not folder.exists())


def _remove_traces() -> None:
    """Removes the folders that the command has made, unless there is more in them than Hydra's."""
    for folder in NEW:
        with suppress(OSError):
            if {entry.name for entry in folder.iterdir()} <= HYDRAS_OWN:
                shutil.rmtree(folder)


def _record_failure(folder: Path, error: Exception) -> float:
    """Records in a run's folder that it failed, and says so.

    Nothing is recorded of a run that another process is working on: the folder is not ours.

    Returns:
        NaN, for the run's value.
    """
    message, code = one_line(error, folder), exit_code(error)
    if not isinstance(error, InUseError):
        content = {"message": message, "kind": type(error).__name__, "exit_code": code}
        RunFolder(folder).write_json(FAILURE, content)
    if code == UNFORESEEN:
        traceback.print_exception(error)
    print(f"error: {message}", file=sys.stderr)
    return math.nan
