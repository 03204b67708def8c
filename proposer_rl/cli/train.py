"""Runs ``bin/train``: composes the settings of one run or of a sweep, and carries the runs out.

Composing needs no PyTorch, so that a typing error is reported at once. A run of a sweep that fails
leaves the reason in its folder.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import traceback
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from proposer_rl.cli.errors import UNFORESEEN, ConfigError, command, exit_code, one_line, refuse
from proposer_rl.cli.groups import arranged, check_chosen, check_scale, invocation
from proposer_rl.recipes import CONFIG_FOLDER, composed, explained, plain_values
from proposer_rl.runs.folder import FAILURE, RunFolder
from proposer_rl.runs.process import InUseError, StopSignals, guard_output

# The folder of the command's run or sweep; of a sweep, also the failures recorded there before.
COMMAND: list[tuple[Path, dict[Path, int] | None]] = []


class FailedRunError(RuntimeError):
    """A run of a sweep has failed; the reason is recorded, and sweepers count it as a failure."""


class CommandFolder(Callback):
    """Records the folder of the command's run or sweep before Hydra creates it."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """Records a run's folder."""
        COMMAND.append((Path(config.hydra.run.dir).absolute(), None))

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Records a sweep's folder, and which runs failed there before."""
        folder = Path(config.hydra.sweep.dir).absolute()
        COMMAND.append((folder, _failures(folder)))


def main() -> None:
    """Runs the command; the exit codes are those of :mod:`proposer_rl.cli.errors`."""
    # With this Hydra raises its errors, so that they can be printed in one line here.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    command(_compose_and_run)


def _compose_and_run() -> None:
    COMMAND.clear()
    if sys.version_info >= (3, 14):  # which refuses a help text of Hydra 1.3 that is no string
        ArgumentParser._check_help = lambda self, action: None
    try:
        _prepare_arguments()
        _main()
    except FailedRunError:
        pass  # it has been printed, and is in the sweep's overview
    except (HydraException, OmegaConfBaseException, UnicodeDecodeError, YAMLError) as error:
        raise ConfigError(explained(error)) from error
    except (OSError, ValueError) as error:
        # Hydra could not write its own files; logging wraps this in a ValueError.
        cause = error if isinstance(error, OSError) else error.__cause__
        if not isinstance(cause, OSError):
            raise
        refuse(cause, *(folder for folder, _ in COMMAND))
    for folder, failed_before in COMMAND:
        if failed_before is not None:
            from proposer_rl.cli.watch import show_sweep

            show_sweep(folder)
            failed = _failures(folder).items() - failed_before.items()
            codes = [int(json.loads(file.read_text())["exit_code"]) for file, _ in failed]
            sys.exit(max(codes, default=0))


@hydra.main(version_base="1.3", config_path=str(CONFIG_FOLDER), config_name="train")
def _main(hydra_config: DictConfig) -> float:
    guard_output()  # again, since launchers start processes that begin here
    about = HydraConfig.get()
    path, in_sweep = Path(about.runtime.output_dir), about.mode == RunMode.MULTIRUN
    signals = StopSignals()
    try:
        (path / FAILURE).unlink(missing_ok=True)  # a run that failed before starts again
        asked = invocation(about, path)
        check_scale(asked.overrides)
        check_chosen(hydra_config, about)
        with signals:  # from here on, since imports must not be interrupted
            from proposer_rl.cli.config import read_config  # late, since it takes seconds
            from proposer_rl.cli.run import train
            from proposer_rl.cli.watch import show_run

            return train(read_config(hydra_config), asked, signals, show_run)
    except Exception as error:
        if not in_sweep:
            if exit_code(error) != UNFORESEEN:
                refuse(error, path)
            raise
        message = _record_failure(path, error)
    finally:
        if in_sweep:
            # Environments are in reference cycles and may hold gigabytes outside of Python's view,
            # as MuJoCo's models do, to which the next run would add its own.
            gc.collect()
    # Outside of the handler, since the error's frames would keep the run's memory alive.
    raise FailedRunError(message)


def _prepare_arguments() -> None:
    """Refuses options that are not supported, and spells overrides as Hydra takes them."""
    read = get_args_parser().parse_args()
    if read.experimental_rerun is not None:  # Hydra would read a pickle, which may run code
        raise ConfigError("--experimental-rerun: not supported; give the run's own arguments again")
    folder = read.config_path or read.config_name
    if read.config_dir and not folder and (CONFIG_FOLDER / Path(read.config_dir).name).is_dir():
        folder = f"{read.config_dir} is a group"
    if folder:
        raise ConfigError(
            f"{folder}: give the folder that holds task/, method/ and so on, and the file's name, "
            "as in: --config-dir my_conf task=hill"
        )
    options = [word for word in sys.argv[1:] if word not in read.overrides]
    overrides = arranged(read.overrides)
    if read.cfg == "job":
        more = Path(read.config_dir).absolute() if read.config_dir else CONFIG_FOLDER
        _show_settings([*overrides, f'hydra.searchpath=["file://{more}"]'], read)
        sys.exit()
    sys.argv[1:] = [*overrides, *options]


def _show_settings(words: Sequence[str], read: Namespace) -> None:
    """Prints the composed settings as Hydra does, with the defaults that are in no file."""
    from proposer_rl.methods import completed  # late, since it takes seconds

    config = OmegaConf.create(completed(plain_values(composed(words))))
    part: Any = OmegaConf.select(config, read.package or "")
    text = OmegaConf.to_yaml(part, resolve=read.resolve) if OmegaConf.is_config(part) else part
    print(str(text).rstrip())


def _failures(folder: Path) -> dict[Path, int]:
    """Returns the files in a sweep's folder that record failed runs, with their times."""
    return {file: file.stat().st_mtime_ns for file in folder.rglob(FAILURE)}


def _record_failure(folder: Path, error: Exception) -> str:
    """Records in a run's folder that it failed, and returns the error's line.

    Nothing is written if another process is working in the folder.
    """
    message, code = one_line(error, folder), exit_code(error)
    if not isinstance(error, InUseError):
        content = {"message": message, "kind": type(error).__name__, "exit_code": code}
        RunFolder(folder).write_json(FAILURE, content)
    if code == UNFORESEEN:
        traceback.print_exception(error)
    print(f"error: {message}", file=sys.stderr)
    return message
