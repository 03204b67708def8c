from __future__ import annotations

import gc
import os

# Before anything imports pyplot: tests draw into files, also where there is no display.
os.environ.setdefault("MPLBACKEND", "Agg")
# And before PyTorch, as commands do: how threads wait beside other processes.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import signal
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

if TYPE_CHECKING:
    from tests.processes import Processes

# Until all is imported, of which nothing is garbage: to look for it takes a fifth of that time.
gc.disable()

# A busy machine makes an example slow, not wrong.
hypothesis.settings.register_profile("proposer_rl", deadline=None, max_examples=25)
hypothesis.settings.load_profile("proposer_rl")


# Started by nohup, or in the background of a script, this process ignores these two, and so would
# every process that a test starts and then interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# What tests write need not outlive the machine, and waiting for disks takes long.
os.fsync = lambda file: None


def pytest_configure() -> None:
    """In a new environment nothing is compiled: of two processes one starts with other imports."""
    if os.environ.get("PYTEST_XDIST_WORKER") == "gw1":
        for name in ("pandas", "scipy.stats", "sklearn", "matplotlib.pyplot", "sympy"):
            import_module(name)


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.parent == Path(__file__).parent / "research":
            item.add_marker("research")
        if item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.timeout(3600))
    # First what lasts longest, so that no process waits at the end for another's; they share one
    # process that forks.
    first = {item.path for item in items if "processes" in getattr(item, "fixturenames", ())}
    items.sort(key=lambda item: item.path not in first)


def pytest_collection_finish() -> None:
    """Where tests run; the process that only deals them out to others imports nothing for them."""
    import torch

    from tests import committed, composing

    committed.remember()
    composing.remember()
    # Tensors in tests are too small for threads to pay, and tests share the machine.
    torch.set_num_threads(1)
    # What was imported stays: no need to look for garbage in it again and again.
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()


@pytest.fixture(autouse=True)
def _seeded() -> None:
    """TorchRL's distributions draw from the global generator."""
    import torch

    torch.default_generator.manual_seed(0)  # torch.manual_seed takes a millisecond for all devices


@pytest.fixture(autouse=True)
def _undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture at the end of a run takes a third of a smoke run, and few tests look at it."""
    from proposer_rl.cli import watch

    if request.node.get_closest_marker("pictures") is None:
        monkeypatch.setattr(watch, "draw_run", _draw_nothing)


def _draw_nothing(folder: Path, title: str) -> Path:
    from PIL import Image

    Image.new("RGB", (1, 1)).save(folder / "run.png")
    return folder / "run.png"


@pytest.fixture(scope="session")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """Calls the command in processes of its own."""
    from tests.processes import Processes

    running = Processes(tmp_path_factory.mktemp("processes"))
    yield running
    running.close()


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two Solvers side by side in mazes, three checkpoints. Who changes the folder takes a copy."""
    from tests.commands import trained_run

    return trained_run(
        tmp_path_factory.mktemp("runs") / "trained",
        *("+method=target", "+scale=smoke", "compute.progress=false", "seeds=[3,5]"),
        *("task.evaluation.levels=40", "schedule.keep_checkpoints=100"),
        "schedule.checkpoint_every=2",
    )


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Works in a folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def train() -> Callable[..., int]:
    """Calls ``bin/train`` in this process; returns its exit code."""
    from proposer_rl.cli.train import main
    from tests.commands import call

    return partial(call, main)
