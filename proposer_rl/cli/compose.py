"""A run from overrides, in a process that is not Hydra's: what ``prl.train`` calls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from itertools import chain, count
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.errors import HydraException
from omegaconf import DictConfig, open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from proposer_rl.cli import shown
from proposer_rl.cli.config import read_config
from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.groups import check_groups, explained
from proposer_rl.cli.run import carry_out
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.folder import storage
from proposer_rl.runs.process import StopSignals


def compose_and_run(overrides: Sequence[str], own: Mapping[str, Any], folder: Path | None) -> Path:
    """Trains as ``bin/train`` with these overrides does.

    Args:
        overrides: as on the command line.
        own: what takes the place of top-level keys; of a task or curriculum that no file has.
        folder: the run's; None for a new one below ``outputs/``.

    Returns:
        The run's folder.

    Raises:
        ConfigError: naming the first wrong key, its value and what is allowed.
        Interrupted: if a signal asked the run to stop; all is saved then.
    """
    with _composed(overrides) as config:
        with open_dict(config):
            del config["hydra"]
            for key, value in own.items():
                config[key] = value
        check_groups(list(overrides))
        with _folder(folder, config) as path, StopSignals() as signals:
            carry_out(read_config(config), path, signals, shown)
    return path


@contextmanager
def _folder(given: Path | None, config: DictConfig) -> Iterator[Path]:
    """Yields the run's folder; a new one is removed again if the run is refused."""
    if given is not None:
        yield given
        return
    parent = Path("outputs") / str(config.method)
    first = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_seed_{config.seed}"
    new = [folder for folder in (parent, *parent.parents) if not folder.exists()]
    for name in chain([first], (f"{first}_{number}" for number in count(2))):
        with storage(path := parent / name), suppress(FileExistsError):
            path.mkdir(parents=True)
            break
    try:
        yield path
    except BaseException:
        for folder in (path, *new):
            with suppress(OSError):  # where something has been written
                folder.rmdir()
        raise


@contextmanager
def _composed(overrides: Sequence[str]) -> Iterator[DictConfig]:
    """Yields the configuration, with Hydra's globals set for it and restored afterwards."""
    before = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
            config = compose("train", list(overrides), return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        yield config
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(explained(error)) from error
    finally:
        Singleton.set_state(before)
