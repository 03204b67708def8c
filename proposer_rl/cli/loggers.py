"""Rows of metrics to TensorBoard or Weights & Biases, through TorchRL's loggers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.record.loggers import get_logger

from proposer_rl.cli.config import ConfigError, LoggerSettings
from proposer_rl.experiment import Log


def make_log(settings: LoggerSettings, path: Path, name: str) -> Log | None:
    """A function that logs a row of a table, or None where the run's folder is enough.

    Args:
        settings: which logger.
        path: the run's folder, where files of the logger go.
        name: of the run.

    Raises:
        ConfigError: if the logger's package is not installed.
    """
    if settings.type == "csv":
        return None
    options: dict[str, Any] = {}
    if settings.type == "wandb":
        options["wandb_kwargs"] = {"project": settings.project, "mode": settings.mode}
    try:
        logger = get_logger(settings.type, str(path), name, **options)
    except ImportError as error:
        raise ConfigError(
            f"logger={settings.type}: its package is missing; install it with "
            f"pip install 'proposer_rl[{settings.type}]'"
        ) from error
    if logger is None:
        raise ConfigError(f"logger={settings.type}: TorchRL has no such logger")

    def log(table: str, row: Mapping[str, float], step: int) -> None:
        for key, value in row.items():
            logger.log_scalar(f"{table}/{key}", value, step=step)

    return log
