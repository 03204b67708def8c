"""Checks for packages that only some runs need, and says how to install them."""

from __future__ import annotations

import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def install_command(extra: str) -> str:
    """Returns the command that installs an extra into the environment of this process.

    In a checkout it uses the versions that are pinned there.
    """
    what = [f"proposer_rl[{extra}]"]
    constraints = ROOT / "constraints.txt"
    if constraints.is_file():
        what = ["-c", str(constraints), "-e", f"{ROOT}[{extra}]"]
    return shlex.join([sys.executable, "-m", "pip", "install", *what])


class MissingPackageError(ImportError):
    """A package of an extra is not installed; the message is one line with the command for it."""

    exit_code = 2


def require_package(what: str, extra: str, *modules: str) -> None:
    """Checks that the packages of an extra are installed.

    Args:
        what: the setting or command that needs them.
        extra: the name of the extra.
        modules: that must be importable.

    Raises:
        MissingPackageError: if a module is not installed.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        how = install_command(extra)
        raise MissingPackageError(f"{what} needs {' and '.join(missing)}; install with: {how}")


def where_to_look(error: BaseException) -> str:
    """Returns which Python lacks a module and how to add it; empty for other errors."""
    if not isinstance(error, ModuleNotFoundError):
        return ""
    return (
        f"; {sys.executable} cannot find it: install it there, or, if it is your own, put its "
        "folder on PYTHONPATH, as in PYTHONPATH=. bin/train ..."
    )
