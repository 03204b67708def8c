"""Sweeps: a run that fails is recorded and listed, and does not take the others with it."""

from __future__ import annotations

import json
import math
import sys
import traceback
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from rich.console import Console

from proposer_rl.report.progress import FAILURE, find_progress
from proposer_rl.report.terminal import overview
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.lock import InUseError


class SweepSummary(Callback):
    """Lists the runs of a sweep when it is over; the exit code is that of a failed one."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Called by Hydra after the last run, whatever became of the runs."""
        found = find_progress(Path(config.hydra.sweep.dir))
        Console().print(overview(found))
        codes = [_exit_code(progress.folder) for progress in found]
        if any(codes):
            # Hydra turns an exception of a callback into a warning, but lets an exit through.
            sys.exit(max(codes))


def forget_failure(folder: Path) -> None:
    """A run that failed is tried again: what is recorded of the failure no longer holds."""
    (folder / FAILURE).unlink(missing_ok=True)


def record_failure(folder: Path, error: Exception, message: str, exit_code: int) -> float:
    """Record in a run's folder that it failed, and say so.

    Of a run that another process is working on nothing is recorded: the folder is not ours.

    Args:
        folder: of the run.
        error: what happened.
        message: in one line.
        exit_code: of the sweep; 2 for bad input, whose traceback tells nothing.

    Returns:
        NaN, for the run's value.
    """
    if not isinstance(error, InUseError):
        content = {"message": message, "kind": type(error).__name__, "exit_code": exit_code}
        write_atomically(folder / FAILURE, (json.dumps(content, indent=2) + "\n").encode())
    if exit_code == 1:
        traceback.print_exception(error)
    print(f"error: {message}", file=sys.stderr)
    return math.nan


def _exit_code(folder: Path) -> int:
    path = folder / FAILURE
    return int(json.loads(path.read_text())["exit_code"]) if path.is_file() else 0
