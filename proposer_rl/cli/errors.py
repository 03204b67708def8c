"""Errors of the command line and exit codes.

A foreseen error is a class with an ``exit_code``, and its message is one line. Functions of this
package raise :class:`ConfigError` for wrong input. docs/reference/exit_codes.md lists the codes:
2 bad input, 3 divergence, 4 storage, 5 a folder in use, 6 lost workers, 128 plus its number for a
signal, and 1, Python's own, for an unforeseen error.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from signal import SIGINT
from typing import NoReturn, TypeVar

from proposer_rl.runs.process import Output, guard_output

BAD_INPUT = 2
STORAGE = 4
UNFORESEEN = 1
SIGNALLED = 128
Number = TypeVar("Number", int, float)


class ConfigError(ValueError):
    """The configuration or another input is wrong; the message is one line."""

    exit_code = BAD_INPUT


def command(body: Callable[[], None]) -> None:
    """Runs the body of a command; a foreseen error ends it with one line and its exit code."""
    guard_output()
    try:
        body()
    except KeyboardInterrupt:
        sys.exit(SIGNALLED + SIGINT)
    except Exception as error:
        refuse(error)


def say(text: str) -> None:
    """Prints a text on standard output, above progress bars; never raises."""
    from tqdm import tqdm

    tqdm.write(text, file=Output(sys.stdout))


def refuse(error: Exception, folder: Path | None = None) -> NoReturn:
    """Prints an error in one line, as :func:`one_line` does, and exits with its code.

    Raises:
        Exception: the error itself, if it is unforeseen.
    """
    code = exit_code(error)
    if code == UNFORESEEN:
        raise error
    print(f"error: {one_line(error, folder)}", file=sys.stderr)
    sys.exit(code)


def exit_code(error: BaseException) -> int:
    """Returns the exit code of an error; a lost connection is no error of the disk."""
    if lacks_memory(error):
        return BAD_INPUT
    storage = isinstance(error, OSError) and not isinstance(error, ConnectionError)
    return int(getattr(error, "exit_code", STORAGE if storage else UNFORESEEN))


def lacks_memory(error: BaseException) -> bool:
    """Returns whether an error means that memory was exhausted, on the CPU or a GPU."""
    # Matches only torch's own words, since other errors must keep their tracebacks.
    torchs = isinstance(error, RuntimeError) and "tried to allocate" in str(error).lower()
    return torchs or isinstance(error, MemoryError)


def one_line(error: BaseException, folder: Path | None = None) -> str:
    """Returns an error's message without line breaks and other control characters.

    Args:
        error: the error.
        folder: the folder that was written to, for an error of the disk that names no file.
    """
    text = str(error)
    if isinstance(error, OSError) and error.strerror and (place := error.filename or folder):
        text = f"cannot use {place}: {error.strerror}"
    if lacks_memory(error):
        text = f"the run does not fit in memory: {text}"
    return "".join(c for c in " ".join(text.split()) if c.isprintable())


def number(
    kind: Callable[[str], Number], least: float = -math.inf, most: float = math.inf
) -> Callable[[str], Number]:
    """Returns a type for argparse that takes finite numbers in a range."""
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
    """Refuses an output file of an unknown kind or in a missing folder, before any work."""
    if file is not None and not (file.suffix in suffixes and file.parent.is_dir()):
        raise ConfigError(
            f"--{option} {file}: must end in {' or '.join(suffixes)}, in a folder that exists"
        )


def settings_file(folder: Path) -> Path:
    """Returns the path of a run's ``config.json``; refuses a folder without one."""
    file = folder / "config.json"
    if not file.is_file():
        raise ConfigError(f"{folder}: is not a run's folder: it has no config.json")
    return file
