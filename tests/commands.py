"""Commands called in this process, as users call them in a shell."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from pathlib import Path

from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from proposer_rl.cli.train import main

# Seconds, and less than ``+scale=smoke`` takes alone: nothing is learnt in so little.
LITTLE = ["solver.ppo.horizon=5", "solver.ppo.epochs=1", "task.network.channels=[8,8]"]
SMOKE = ["+scale=smoke", "compute.progress=false", *LITTLE]


def call(command: Callable[[], object], *arguments: str) -> int:
    """Calls a command that reads the command line; returns its exit code."""
    GlobalHydra.instance().clear()
    HydraConfig.instance().cfg = None
    before, sys.argv = sys.argv, ["command", *arguments]
    try:
        command()
    except SystemExit as end:
        return int(end.code or 0)
    finally:
        sys.argv = before
        _forget_loggers()
    return 0


def trained_run(folder: Path, *arguments: str) -> Path:
    """The folder of a run that ``bin/train`` has made."""
    assert call(main, *arguments, f"hydra.run.dir={folder}") == 0
    return folder


def _forget_loggers() -> None:
    """Hydra's loggers write to what stood for the terminal in the test that called the command."""
    for logger in (logging.getLogger(), logging.getLogger("hydra")):
        for handler in logger.handlers[:]:
            if type(handler) in (logging.StreamHandler, logging.FileHandler):
                logger.removeHandler(handler)
                handler.close()
