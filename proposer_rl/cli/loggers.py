"""Rows of a run's tables to TensorBoard or Weights & Biases, through TorchRL's loggers."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torchrl.record.loggers import get_logger

from proposer_rl.cli.config import ConfigError
from proposer_rl.experiment import Log
from proposer_rl.extras import install_command
from proposer_rl.report.records import numbers, picture
from proposer_rl.runs.folder import write_atomically
from proposer_rl.settings import LoggerSettings

WANDB_ID = "wandb_id.txt"
COLUMNS, GAP = 4, 8  # of a sheet of pictures; white pixels between them


def require_logger(settings: LoggerSettings) -> None:
    """Check that a logger can be used, before anything is written.

    Raises:
        ConfigError: if its package, of the same name, is not installed.
    """
    if settings.type != "csv" and find_spec(settings.type) is None:
        raise ConfigError(
            f"logger={settings.type}: its package is missing; install it with: "
            f"{install_command(settings.type)}"
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
        # Of a sweep in one process each run is its own.
        reinit = "finish_previous"
        options["wandb_kwargs"] = {
            "project": settings.project, "mode": settings.mode, "reinit": reinit,
            "id": wandb_id(path), "resume": "allow",
        }  # fmt: skip
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


def wandb_id(path: Path) -> str:
    """The run's name at Weights & Biases, kept in its folder: a run that goes on is no second."""
    file = path / WANDB_ID
    if not file.is_file():
        write_atomically(file, secrets.token_hex(4).encode())
    return file.read_text(encoding="utf-8").strip()


def _numbers(row: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """A row's numbers, of a list of them the maximum and the mean."""
    for key, value in row.items():
        if isinstance(value, int | float):
            yield key, value
        elif (found := numbers(value)) is not None:
            yield f"{key}_max", float(found.max())
            yield f"{key}_mean", float(found.mean())


def _images(row: Mapping[str, Any], path: Path) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """What of a row is seen better than read, as uint8 [H, W, 3]."""
    levels = row.get("levels", ())
    for name, records in levels.items() if isinstance(levels, Mapping) else [("levels", levels)]:
        found = [picture(record.get("picture")) for record in records]
        tiles = [tile for tile in found if tile is not None]
        if tiles:
            yield name, _sheet(tiles)
    if "histogram" in row:
        from proposer_rl.report.pictures import last_map  # figures, which other loggers need not

        image = last_map(path)
        if image is not None:
            yield "histogram", image


def _sheet(tiles: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Pictures side by side on white, four in a row."""
    height, width = (max(tile.shape[side] for tile in tiles) + GAP for side in (0, 1))
    rows = -(-len(tiles) // COLUMNS)
    sheet = np.full((rows * height, min(len(tiles), COLUMNS) * width, 3), 255, np.uint8)
    for number, tile in enumerate(tiles):
        top, left = number // COLUMNS * height, number % COLUMNS * width
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return sheet[:-GAP, :-GAP]
