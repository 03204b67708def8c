"""Logs the numbers of a run's tables to TensorBoard or Weights & Biases."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from proposer_rl.cli.config import LoggerSettings
from proposer_rl.experiment import Log
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.records import flat

ID = "wandb_id.txt"

Write = Callable[[Mapping[str, float], int], None]
"""Writes numbers of an update, by their names."""


@contextmanager
def logger(
    settings: LoggerSettings, path: Path, name: str, config: Mapping[str, Any]
) -> Iterator[Log | None]:
    """Yields a function that logs rows of a run's tables; None if no logger is asked for."""
    if settings.type == "csv":
        yield None
        return
    tensorboard = settings.type == "tensorboard"
    opened = (
        _tensorboard(path / name, config) if tensorboard else _wandb(settings, path, name, config)
    )
    with opened as write:

        def log(table: str, row: Mapping[str, Any], step: int) -> None:
            write({f"{table}/{key}": value for key, value in flat(row).items()}, step)

        yield log


@contextmanager
def _tensorboard(folder: Path, config: Mapping[str, Any]) -> Iterator[Write]:
    from torch.utils.tensorboard import SummaryWriter

    writer: Any = None
    with ExitStack() as stack:

        def write(found: Mapping[str, float], step: int) -> None:
            nonlocal writer
            if writer is None:
                # A resumed run repeats the rows that were written after its checkpoint.
                writer = stack.enter_context(SummaryWriter(folder, purge_step=step))
                for key, value in config.items():
                    writer.add_text(f"config/{key}", str(value), step)
            for key, value in found.items():
                writer.add_scalar(key, value, step)
            writer.flush()  # so that they can be seen during the run

        yield write


@contextmanager
def _wandb(
    settings: LoggerSettings, path: Path, name: str, config: Mapping[str, Any]
) -> Iterator[Write]:
    """Yields a function that writes to W&B, whose variables count where a setting is None."""
    import wandb

    run = wandb.init(
        project=settings.project or os.environ.get("WANDB_PROJECT", "proposer_rl"),
        mode=settings.mode,
        dir=path,
        name=name,
        id=wandb_id(path),
        resume="allow",
        config=dict(config),
        reinit="create_new",  # beside a run that the caller may have
    )
    code = 1
    try:
        # The rows of one update become one step. W&B ignores steps that a resumed run repeats.
        yield lambda found, step: run.log(dict(found), step=step)
        code = 0
    finally:
        run.finish(exit_code=code)


def wandb_id(path: Path) -> str:
    """Returns a run's id at Weights & Biases, which is kept in its folder for resuming."""
    file = path / ID
    if not file.is_file():
        write_atomically(file, secrets.token_hex(4).encode())
    return file.read_text(encoding="utf-8-sig").strip()
