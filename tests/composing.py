"""Hydra composes a configuration from the same files a thousand times: here, each of them once."""

from __future__ import annotations

import copy
import os
import pickle
from contextlib import suppress
from functools import cache, partial
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.defaults_list import DefaultsList, create_defaults_list
from hydra._internal.hydra import Hydra
from hydra.core.default_element import ResultDefault
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

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


def only_ours(repo: Any) -> bool:
    """Whether all files are the package's, and none of those that tests write."""
    sources = [source.path for source in repo.get_sources() if source.path]
    return all(path in (str(CONFIG_FOLDER), "hydra.conf") for path in sources)


listed: dict[str, bytes] = {}


def list_once(
    repo: Any, config_name: str, overrides_list: list[Override], *how: bool, **named: bool
) -> DefaultsList:
    """Which files those are depends on the groups that are chosen, and on no other values."""
    given: dict[bool, list[Override]] = {True: [], False: []}
    for override in overrides_list:
        if not override.is_sweep_override():
            is_value = isinstance(override.value(), dict)
            given[not is_value and repo.group_exists(override.key_or_group)].append(override)
    make = partial(create_defaults_list, repo, config_name)
    if not only_ours(repo):
        return make(overrides_list, *how, **named)
    key = repr((config_name, [override.input_line for override in given[True]], how, named))
    if key not in listed:
        listed[key] = pickle.dumps(make(given[True], *how, **named))
    found: DefaultsList = pickle.loads(listed[key])
    found.config_overrides = given[False]
    return found


compose = ConfigLoaderImpl._compose_config_from_defaults_list
composed: dict[str, bytes] = {}


def compose_once(self: ConfigLoaderImpl, defaults: list[ResultDefault], repo: Any) -> DictConfig:
    """The same files, one merged into the other, are the same; most share all but the last ones."""
    if not only_ours(repo):
        return compose(self, defaults, repo)
    key = repr([(default, default.override_key) for default in defaults])
    if key not in composed:
        *before, last = defaults
        config = compose(self, [last], repo)
        if before:
            first, second = compose_once(self, before, repo), config
            try:
                with flag_override(first, "no_deepcopy_set_nodes", True):
                    first.merge_with(second)
                config = first
            except OmegaConfBaseException:
                config = compose(self, defaults, repo)  # Hydra says what does not fit
        composed[key] = pickle.dumps(config)
    return pickle.loads(composed[key])


get_mode = Hydra.get_mode


def mode_at_once(self: Hydra, config_name: str | None, overrides: list[str]) -> Any:
    """Hydra composes all twice, the first time to see whether it is a sweep by its settings."""
    swept = any("sweep" in override or "hydra.mode" in override for override in overrides)
    return get_mode(self, config_name, overrides) if swept else None


def remember() -> None:
    """Let Hydra work so in this process, and in those that it forks into."""
    OmegaConf.load = staticmethod(load_once)
    CachingConfigRepository.__init__ = copy_little
    config_loader_impl.create_defaults_list = list_once
    ConfigLoaderImpl._compose_config_from_defaults_list = compose_once
    Hydra.get_mode = mode_at_once


@cache
def prepare(overrides: tuple[str, ...]) -> None:
    """Compose these now, so that what this process forks into finds it done; errors are theirs."""
    with suppress(Exception), initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        hydra_compose("train", [*overrides])
