"""Composes and carries out a run for ``prl.train``, without Hydra's command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import chain, count
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from proposer_rl.cli.config import RunConfig, read_config
from proposer_rl.cli.groups import Invocation, check_scale, documented, python_path
from proposer_rl.cli.run import carry_out
from proposer_rl.cli.watch import show_run
from proposer_rl.recipes import composed, plain_values, storable
from proposer_rl.runs.folder import storage
from proposer_rl.runs.process import StopSignals


def compose_and_run(
    words: Sequence[str], settings: Sequence[Mapping[str, Any]], folder: Path | None
) -> Path:
    """Trains as ``bin/train`` does with the same settings; several threads may call it at once.

    Args:
        words: overrides of Hydra's that choose files.
        settings: by top-level key, merged into those of the files; of two the later one counts.
        folder: of the run; None for a new one below ``outputs/``.

    Returns:
        The run's folder, absolute.

    Raises:
        ArgumentError: naming the first wrong key, its value and what is allowed.
        Interrupted: if a signal asked the run to stop; all is saved then.
    """
    check_scale(words)
    own = [{key: storable(key, value) for key, value in some.items()} for some in settings]
    config = read_config(composed(words, *own))
    asked = plain_values(OmegaConf.merge({}, *own))
    path = (folder or _new_folder(config)).expanduser().absolute()
    invocation = Invocation(path, documented(words), python_path=python_path(), settings=asked)
    with StopSignals() as signals:
        carry_out(config, invocation, signals, show_run)
    return path


def _new_folder(config: RunConfig) -> Path:
    """Creates a folder for a run."""
    parent = Path("outputs") / config.method
    first = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_seed_{config.seed}"
    for name in chain([first], (f"{first}_{number}" for number in count(2))):
        with storage(path := parent / name), suppress(FileExistsError):
            path.mkdir(parents=True)
            break
    return path
