"""``bin/train``, but for its help: from the command line to the settings of one or more runs.

What composes them needs no PyTorch, so that a typing error is told at once.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from proposer_rl.cli.callbacks import (
    LostJobError,
    command_folder,
    forget_failure,
    record_failure,
    remove_traces,
)
from proposer_rl.cli.errors import UNFORESEEN, ConfigError, command, exit_code, one_line, refuse
from proposer_rl.cli.groups import check_chosen, check_groups, explained, overrides
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.process import StopSignals

LONGEST = 300  # characters of what is said of a lost job
BEGUN: list[Path] = []  # folders of this process's runs: what comes after is no matter of overrides


def main() -> None:
    """Entry point; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
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
        remove_traces()
        raise ConfigError(explained(error)) from error
    except RuntimeError as error:
        if not type(error).__module__.startswith("submitit."):
            raise
        raise LostJobError(
            f"no job was sent, or it left no result: {one_line(error)[:LONGEST]}"
        ) from error
    except OSError as error:  # of Hydra's own files
        remove_traces()
        refuse(error, command_folder())
    except ValueError as error:
        if BEGUN:
            raise
        remove_traces()
        if isinstance(error.__cause__, OSError):  # of the file that logging cannot open
            refuse(error.__cause__)
        raise ConfigError(one_line(error)) from error  # of an override such as +method=3


@hydra.main(version_base="1.3", config_path=str(CONFIG_FOLDER), config_name="train")
def _main(hydra_config: DictConfig) -> float:
    BEGUN.append(path := Path(HydraConfig.get().runtime.output_dir))
    signals = StopSignals()
    try:
        forget_failure(path)
        check_groups(overrides())
        check_chosen(hydra_config)
        with signals:  # already now: amid imports is no place to stop
            from proposer_rl.cli import shown  # only now: it takes seconds
            from proposer_rl.cli.config import read_config
            from proposer_rl.cli.run import train

            return train(read_config(hydra_config), path, signals, shown)
    except Exception as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            return record_failure(path, error)
        if exit_code(error) != UNFORESEEN:
            remove_traces()
            refuse(error, path)
        raise


def _refuse_pickles(arguments: list[str]) -> None:
    """Hydra's --experimental-rerun reads a pickle, which can run whatever it likes."""
    if any(argument.startswith("--experimental-rerun") for argument in arguments):
        raise ConfigError("--experimental-rerun: not supported; give the run's own arguments again")
