"""A run from overrides, in a process that is not Hydra's: what ``prl.train`` calls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import chain, count
from pathlib import Path
from threading import RLock
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.errors import HydraException
from omegaconf import open_dict
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from proposer_rl.cli.config import RunConfig, read_config
from proposer_rl.cli.errors import ConfigError
from proposer_rl.cli.groups import Invocation, arranged, check_groups, explained, invocation
from proposer_rl.cli.run import carry_out
from proposer_rl.cli.watch import show_run
from proposer_rl.recipes import CONFIG_FOLDER
from proposer_rl.runs.folder import storage
from proposer_rl.runs.process import StopSignals

COMPOSING = RLock()  # Hydra composes with globals of the process


def compose_and_run(overrides: Sequence[str], own: Mapping[str, Any], folder: Path | None) -> Path:
    """Trains as ``bin/train`` with these overrides does; threads may call it side by side.

    Args:
        overrides: as on the command line.
        own: what takes the place of top-level keys; of a task or curriculum that no file has.
        folder: the run's; None for a new one below ``outputs/``.

    Returns:
        The run's folder, absolute.

    Raises:
        ConfigError: naming the first wrong key, its value and what is allowed.
        Interrupted: if a signal asked the run to stop; all is saved then.
    """
    with COMPOSING:
        config, asked = _composed(overrides, own, folder)
    with StopSignals() as signals:
        carry_out(config, asked, signals, show_run)
    return asked.folder


def _composed(
    overrides: Sequence[str], own: Mapping[str, Any], folder: Path | None
) -> tuple[RunConfig, Invocation]:
    """Returns a run's settings; Hydra's globals are restored afterwards."""
    before = Singleton.get_state()
    GlobalHydra.instance().clear()
    try:
        overrides = arranged(overrides)
        with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
            config = compose("train", overrides, return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        hydra = config.hydra
        with open_dict(config):
            del config["hydra"]
            for key, value in own.items():
                config[key] = value
        check_groups(overrides)
        read = read_config(config)
        return read, invocation(hydra, overrides, folder or _new_folder(read))
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(explained(error)) from error
    finally:
        Singleton.set_state(before)


def _new_folder(config: RunConfig) -> Path:
    """Makes a folder for a run that was given none."""
    parent = Path("outputs") / config.method
    first = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_seed_{config.seed}"
    for name in chain([first], (f"{first}_{number}" for number in count(2))):
        with storage(path := parent / name), suppress(FileExistsError):
            path.mkdir(parents=True)
            break
    return path
