"""Rows of a run's tables, its levels and curves to TensorBoard or Weights & Biases."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from proposer_rl.cli.config import LoggerSettings
from proposer_rl.cli.errors import ConfigError, one_line
from proposer_rl.experiment import Log
from proposer_rl.extras import install_command
from proposer_rl.runs.folder import write_atomically
from proposer_rl.runs.records import batch_shares, numbers, picture

COLUMNS, GAP = 4, 8  # of a sheet of pictures; white pixels between them
ID = "wandb_id.txt"

Picture = NDArray[np.uint8]
Write = Callable[[Mapping[str, float], Mapping[str, Picture], int], None]
"""Writes numbers and pictures uint8 [H, W, 3], by their names, of an update."""


def require_logger(settings: LoggerSettings) -> None:
    """Checks that a logger can be used, before anything is written."""
    if settings.type == "csv":
        return
    if find_spec(settings.type) is None:
        raise ConfigError(
            f"logger={settings.type}: its package is missing; install it with: "
            f"{install_command(settings.type)}"
        )
    mode = settings.mode or os.environ.get("WANDB_MODE", "online")
    if settings.type == "wandb" and mode == "online":
        import wandb

        try:
            wandb.login()
        except (wandb.Error, ValueError) as error:
            raise _refusal(error) from error


@contextmanager
def logger(
    settings: LoggerSettings, path: Path, name: str, config: Mapping[str, Any]
) -> Iterator[Write | None]:
    """Yields a function that writes to a logger; None where the run's folder is enough."""
    if settings.type == "tensorboard":
        with _tensorboard(path / name, config) as write:
            yield write
    elif settings.type == "wandb":
        with _wandb(settings, path, name, config) as write:
            yield write
    else:
        yield None


def log_of(write: Write, last_map: Callable[[], Picture | None]) -> Log:
    """Returns a function that writes numbers and pictures of rows of a run's tables to a logger.

    Args:
        write: to a logger.
        last_map: draws the run's last proposals as a heat map; None where there is none.
    """

    def log(table: str, row: Mapping[str, Any], step: int) -> None:
        found = {f"{table}/{key}": value for key, value in _numbers(row)}
        write(found, {f"{table}/{key}": image for key, image in _images(row, last_map)}, step)

    return log


@contextmanager
def _tensorboard(folder: Path, config: Mapping[str, Any]) -> Iterator[Write]:
    from torch.utils.tensorboard import SummaryWriter

    def write(found: Mapping[str, float], images: Mapping[str, Picture], step: int) -> None:
        for key, value in found.items():
            writer.add_scalar(key, value, step)
        for key, image in images.items():
            writer.add_image(key, image, step, dataformats="HWC")
        writer.flush()  # so that it is seen during the run

    with SummaryWriter(folder) as writer:
        for key, value in config.items():
            writer.add_text(f"config/{key}", str(value))
        yield write


@contextmanager
def _wandb(
    settings: LoggerSettings, path: Path, name: str, config: Mapping[str, Any]
) -> Iterator[Write]:
    """Yields a function that writes to W&B; its variables hold where the settings say nothing."""
    import wandb

    try:
        run = wandb.init(
            project=settings.project or os.environ.get("WANDB_PROJECT", "proposer_rl"),
            mode=settings.mode,
            dir=path,
            name=name,
            id=wandb_id(path),
            resume="allow",
            config=dict(config),
            reinit="finish_previous",  # of a sweep in one process each run is its own
        )
    except (wandb.Error, ValueError) as error:
        raise _refusal(error) from error

    def write(found: Mapping[str, float], images: Mapping[str, Picture], step: int) -> None:
        # What comes of one update, in one row; a run that goes on repeats rows, which are there.
        shown = {key: wandb.Image(image) for key, image in images.items()}
        run.log({**found, **shown}, step=step)

    try:
        yield write
    except BaseException:
        run.finish(exit_code=1)
        raise
    run.finish()


def wandb_id(path: Path) -> str:
    """Returns the id of a run at Weights & Biases, which a resumed run finds in its folder."""
    file = path / ID
    if not file.is_file():
        write_atomically(file, secrets.token_hex(4).encode())
    return file.read_text(encoding="utf-8").strip()


def _refusal(error: Exception) -> ConfigError:
    return ConfigError(
        f"logger=wandb: {one_line(error)}; logger.mode=offline or WANDB_MODE=offline need none"
    )


def _numbers(row: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Yields a row's numbers, maximum and mean of its lists of numbers, and its batch shares."""
    for key, value in row.items():
        if isinstance(value, int | float):
            yield key, value
        elif (found := numbers(value)) is not None:
            yield f"{key}_max", float(found.max())
            yield f"{key}_mean", float(found.mean())
    for name, share in batch_shares(row).items():
        yield f"shares/{name}", share


def _images(
    row: Mapping[str, Any], last_map: Callable[[], Picture | None]
) -> Iterator[tuple[str, Picture]]:
    """Yields pictures of a row: its levels, and its histogram as a heat map."""
    levels = row.get("levels", ())
    for name, records in levels.items() if isinstance(levels, Mapping) else [("levels", levels)]:
        found = [picture(record.get("picture")) for record in records]
        tiles = [tile for tile in found if tile is not None]
        if tiles:
            yield name, _sheet(tiles)
    if "histogram" in row:
        image = last_map()
        if image is not None:
            yield "histogram", image


def _sheet(tiles: Sequence[Picture]) -> Picture:
    """Returns pictures side by side on white, four in a row: uint8 [H, W, 3]."""
    height, width = (max(tile.shape[side] for tile in tiles) + GAP for side in (0, 1))
    rows = -(-len(tiles) // COLUMNS)
    sheet = np.full((rows * height, min(len(tiles), COLUMNS) * width, 3), 255, np.uint8)
    for number, tile in enumerate(tiles):
        top, left = number // COLUMNS * height, number % COLUMNS * width
        sheet[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return sheet[:-GAP, :-GAP]
