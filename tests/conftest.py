from __future__ import annotations

import gc
import os

# Before anything imports pyplot: tests draw into files, also where there is no display.
os.environ.setdefault("MPLBACKEND", "Agg")
# And before PyTorch, as commands do: how threads wait beside other processes.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import pickle
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import hypothesis
import pytest
import torch
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.defaults_list import DefaultsList, create_defaults_list
from hydra._internal.hydra import Hydra
from hydra.core.default_element import ResultDefault
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf
from PIL import Image

from proposer_rl.cli import run
from proposer_rl.cli.train import main
from proposer_rl.recipes import CONFIG_FOLDER
from tests.commands import call
from tests.processes import Processes

# A busy machine makes an example slow, not wrong.
hypothesis.settings.register_profile("proposer_rl", deadline=None, max_examples=25)
hypothesis.settings.load_profile("proposer_rl")


# Started by nohup, or in the background of a script, this process ignores these two, and so would
# every process that a test starts and then interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# What tests write need not outlive the machine, and waiting for disks takes long.
os.fsync = lambda file: None

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


OmegaConf.load = staticmethod(load_once)  # type: ignore[method-assign,assignment]


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


config_loader_impl.create_defaults_list = list_once

compose = ConfigLoaderImpl._compose_config_from_defaults_list
composed: dict[str, bytes] = {}


def compose_once(self: ConfigLoaderImpl, defaults: list[ResultDefault], repo: Any) -> DictConfig:
    """The same files, one merged into the other, are the same."""
    if not only_ours(repo):
        return compose(self, defaults, repo)
    key = repr([(default, default.override_key) for default in defaults])
    if key not in composed:
        composed[key] = pickle.dumps(compose(self, defaults, repo))
    return pickle.loads(composed[key])


ConfigLoaderImpl._compose_config_from_defaults_list = compose_once  # type: ignore[method-assign]

get_mode = Hydra.get_mode


def mode_at_once(self: Hydra, config_name: str | None, overrides: list[str]) -> Any:
    """Hydra composes all twice, the first time to see whether it is a sweep by its settings."""
    swept = any("sweep" in override or "hydra.mode" in override for override in overrides)
    return get_mode(self, config_name, overrides) if swept else None


Hydra.get_mode = mode_at_once  # type: ignore[method-assign]

# Tensors in tests are too small for threads to pay, and tests share the machine.
torch.set_num_threads(1)


def pytest_collection_finish() -> None:
    """What was imported stays: no need to look for garbage in it again and again."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """TorchRL's distributions draw from the global generator."""
    torch.default_generator.manual_seed(0)  # torch.manual_seed takes a millisecond for all devices


@pytest.fixture(autouse=True)
def _undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture at the end of a run takes a third of a smoke run, and few tests look at it."""
    if request.node.get_closest_marker("pictures") is None:
        monkeypatch.setattr(run, "draw_run", _draw_nothing)


def _draw_nothing(folder: Path, title: str) -> Path:
    Image.new("RGB", (1, 1)).save(folder / "run.png")
    return folder / "run.png"


@pytest.fixture(scope="session")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """Calls the command in processes of its own."""
    running = Processes(tmp_path_factory.mktemp("processes"))
    yield running
    running.close()


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Works in a folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def train() -> Callable[..., int]:
    """Calls ``bin/train`` in this process; returns its exit code."""
    return partial(call, main)
