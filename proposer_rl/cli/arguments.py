"""What stands on a command line: numbers, files to be written, and folders of runs."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from proposer_rl.cli.errors import ConfigError

Number = TypeVar("Number", int, float)


def number(
    kind: Callable[[str], Number], least: float = -math.inf, most: float = math.inf
) -> Callable[[str], Number]:
    """The type of an argument that is a finite number in a range, for argparse."""
    allowed = "a whole number" if kind is int else "a number"
    if math.isfinite(most):
        allowed += f" from {least:,} to {most:,}"
    elif math.isfinite(least):
        allowed += f" of at least {least:,}"

    def parse(text: str) -> Number:
        with suppress(ValueError, OverflowError):
            value = kind(text)
            if math.isfinite(value) and least <= value <= most:
                return value
        raise argparse.ArgumentTypeError(f"must be {allowed}, got {text!r}")

    return parse


def check_file(option: str, file: Path | None, *suffixes: str) -> None:
    """Refuse a file that an option asks to be written, before anything is computed."""
    if file is not None and file.suffix not in suffixes:
        raise ConfigError(f"--{option} {file}: must end in {' or '.join(suffixes)}")
    if file is not None and not file.parent.is_dir():
        raise ConfigError(f"--{option} {file}: there is no folder {file.parent}")


def settings_file(folder: Path) -> Path:
    """The file of settings in a run's folder; a folder without one is no run's."""
    file = folder / "config.json"
    if not file.is_file():
        raise ConfigError(f"{folder}: is no run's folder: it has no config.json")
    return file
