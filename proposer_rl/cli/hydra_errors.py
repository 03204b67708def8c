"""What Hydra says of a command that it cannot compose, in one line that says what there is."""

from __future__ import annotations

import re
import sys

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from proposer_rl.cli.errors import one_line
from proposer_rl.cli.groups import ADDED
from proposer_rl.cli.help import own_folders
from proposer_rl.extras import install_command
from proposer_rl.recipes import available

LAUNCHERS = [f"hydra/launcher/{name}" for name in ("joblib", "submitit_local", "submitit_slurm")]
_NOT_CHOSEN = re.compile(r"Could not override '(\w+)'\. No match in the defaults list")


def explained(error: Exception) -> str:
    """The message of an error from composing a configuration."""
    if isinstance(error, UnicodeDecodeError):
        return _not_utf8(error)
    if isinstance(error, MissingConfigException):
        return _no_such_file(error)
    cause = error.__cause__
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return _no_such_key(cause)
    not_chosen = _NOT_CHOSEN.match(str(error))
    if not_chosen and not_chosen[1] in ADDED:
        group, known = not_chosen[1], ", ".join(available(not_chosen[1]))
        return f"{group}: choose one with +{group}=NAME, NAME one of: {known}"
    if isinstance(error, OverrideParseException):
        said = one_line(error).partition(" See https:")[0]
        return (
            f"{error.override}: cannot be read as KEY=VALUE ({said}); a value with other signs "
            "than letters, digits and /:-+.$%*@?|_ has quotes of its own: \"KEY='VALUE'\""
        )
    return one_line(error)


def _not_utf8(error: UnicodeDecodeError) -> str:
    """Of all files in the folders that the command names, the one that was read."""
    files = (file for folder in own_folders(sys.argv) for file in sorted(folder.rglob("*.yaml")))
    named = [f"{file}: " for file in files if file.read_bytes().startswith(error.object)]
    return f"{''.join(named[:1])}is not encoded in UTF-8; save it so ({one_line(error)})"


def _no_such_file(error: MissingConfigException) -> str:
    file = error.missing_cfg_file
    if file in LAUNCHERS:
        return f"{file}: its package is missing; install it with: {install_command('launchers')}"
    known = f"; choose one of: {', '.join(error.options)}" if error.options else ""
    return f"{file}: unknown{known}"


def _no_such_key(error: OmegaConfBaseException) -> str:
    holder = error.parent_node
    if not isinstance(holder, DictConfig):
        return one_line(error)
    known = sorted(str(key) for key in holder if holder._get_full_key(key) != "hydra")
    return f"{error.full_key}: unknown; there are: {', '.join(known) or 'none'}"
