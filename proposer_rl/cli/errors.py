"""What a command that does not come to its end says, and the exit code that it ends with."""

from __future__ import annotations

import sys
from typing import NoReturn

from hydra.errors import HydraException, MissingConfigException
from omegaconf.errors import OmegaConfBaseException

from proposer_rl.cli.config import ConfigError
from proposer_rl.learning.divergence import DivergedError
from proposer_rl.meta.workers import WorkersError
from proposer_rl.runs.checkpoint import CheckpointError
from proposer_rl.runs.lock import InUseError

# docs/reliability.md lists them; 1 is Python's own, for an error that nobody foresaw.
BAD_INPUT = 2
DIVERGED = 3
STORAGE = 4
IN_USE = 5
WORKERS = 6
SIGNALLED = 128  # plus the signal's number, as a shell has it

EXIT_CODES: dict[type[Exception], int] = {
    ConfigError: BAD_INPUT,
    CheckpointError: BAD_INPUT,
    HydraException: BAD_INPUT,
    OmegaConfBaseException: BAD_INPUT,
    DivergedError: DIVERGED,
    OSError: STORAGE,
    InUseError: IN_USE,
    WorkersError: WORKERS,
}
FORESEEN = tuple(EXIT_CODES)


def refuse(error: Exception) -> NoReturn:
    """Say in one line what is wrong, and exit.

    Args:
        error: one of ``FORESEEN``.
    """
    if isinstance(error, MissingConfigException) and error.options:
        message = f"{error.missing_cfg_file}: unknown; choose one of: {', '.join(error.options)}"
    elif isinstance(error, OSError) and error.filename is not None:
        message = f"cannot use {error.filename}: {error.strerror}"
    else:
        message = one_line(error)
    print(f"error: {message}", file=sys.stderr)
    sys.exit(exit_code(error))


def exit_code(error: Exception) -> int:
    """The exit code that an error stands for; 1 for one that nobody foresaw."""
    return next((code for kind, code in EXIT_CODES.items() if isinstance(error, kind)), 1)


def one_line(error: BaseException) -> str:
    """An error's message without line breaks and other control characters."""
    text = " ".join(str(error).split())
    return "".join(character for character in text if character.isprintable())
