"""Rows of a run's tables to TensorBoard or Weights & Biases, through TorchRL's loggers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl.record.loggers import get_logger

from proposer_rl.cli.config import ConfigError, LoggerSettings
from proposer_rl.experiment import Log
from proposer_rl.mazes import Level, draw_grid
from proposer_rl.report.proposals import last_map


def require_logger(settings: LoggerSettings) -> None:
    """Check that a logger can be used, before anything is written.

    Raises:
        ConfigError: if its package, of the same name, is not installed.
    """
    if settings.type != "csv" and find_spec(settings.type) is None:
        raise ConfigError(
            f"logger={settings.type}: its package is missing; install it with "
            f"pip install 'proposer_rl[{settings.type}]'"
        )


def make_log(settings: LoggerSettings, path: Path, name: str) -> Log | None:
    """A function that logs a row of a table, or None where the run's folder is enough.

    Args:
        settings: which logger, of an installed package.
        path: the run's folder, where files of the logger go.
        name: of the run.
    """
    if settings.type == "csv":
        return None
    options: dict[str, Any] = {}
    if settings.type == "wandb":
        options["wandb_kwargs"] = {"project": settings.project, "mode": settings.mode}
    logger = get_logger(settings.type, str(path), name, **options)

    def log(table: str, row: Mapping[str, Any], step: int) -> None:
        for key, value in _numbers(row):
            logger.log_scalar(f"{table}/{key}", value, step=step)
        # TorchRL's loggers have no images; TensorBoard's writer below has.
        if settings.type == "tensorboard":
            for key, image in _images(row, path):
                logger.experiment.add_image(f"{table}/{key}", image, step, dataformats="HWC")
            logger.experiment.flush()  # so that it is seen during the run

    return log


def _numbers(row: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """A row's numbers, of a list of them the maximum and the mean."""
    for key, value in row.items():
        if isinstance(value, int | float):
            yield key, value
        elif isinstance(value, list) and value and isinstance(value[0], int | float):
            yield f"{key}_max", max(value)
            yield f"{key}_mean", sum(value) / len(value)


def _images(row: Mapping[str, Any], path: Path) -> Iterator[tuple[str, Any]]:
    """What of a row is seen better than read, as uint8 [H, W, 3]."""
    if "levels" in row:
        drawings = ["\n".join(item["level"]) for item in row["levels"]]
        paths = [item["path"] for item in row["levels"]]
        yield "levels", draw_grid(Level.from_text(drawings), paths, columns=4).numpy()
    if "histogram" in row:
        image = last_map(path)
        if image is not None:
            yield "histogram", image
