"""Hydra composes a configuration from the same files a thousand times: here, each of them once."""

from __future__ import annotations

import copy
import os
import pickle
from contextlib import suppress
from functools import cache
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.hydra import Hydra
from omegaconf import OmegaConf

from proposer_rl.recipes import CONFIG_FOLDER

load_file = OmegaConf.load
read: dict[tuple[str, int, int], bytes] = {}


def load_once(file: Any) -> Any:
    """Hydra reads the same files of ``conf/`` for each of a thousand compositions."""
    if not hasattr(file, "read"):  # a path, and not Hydra's
        return load_file(file)
    name = file.name
    state = os.stat(name)
    key = (name, state.st_mtime_ns, state.st_size)
    if key not in read:
        read[key] = pickle.dumps(load_file(file))
    return pickle.loads(read[key])  # a copy, at a third of what deepcopy takes


def copy_little(self: CachingConfigRepository, delegate: Any) -> None:
    """Hydra's copy may get other sources, but a list of its own: nothing deeper is changed."""
    self.delegate, self.cache = copy.copy(delegate), {}


get_mode = Hydra.get_mode


def mode_at_once(self: Hydra, config_name: str | None, overrides: list[str]) -> Any:
    """Hydra composes all twice, the first time to see whether it is a sweep by its settings."""
    swept = any("sweep" in override or "hydra.mode" in override for override in overrides)
    return get_mode(self, config_name, overrides) if swept else None


def remember() -> None:
    """Let Hydra work so in this process, and in those that it forks into."""
    OmegaConf.load = staticmethod(load_once)
    CachingConfigRepository.__init__ = copy_little
    Hydra.get_mode = mode_at_once


@cache
def prepare(overrides: tuple[str, ...]) -> None:
    """Compose these now, so that what this process forks into finds it done; errors are theirs."""
    with suppress(Exception), initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        hydra_compose("train", [*overrides])
