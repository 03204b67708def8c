"""Whether the run in a folder is the one that is asked for."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from proposer_rl.cli.config import RunConfig, stored_config
from proposer_rl.cli.errors import ConfigError
from proposer_rl.runs.folder import RunFolder

# What may differ: where it is computed and shown, and a longer schedule.
FREE = {"compute", "logger"}
FREE_SCHEDULE = {"updates", "checkpoint_every", "checkpoint_seconds", "keep_checkpoints"}


def check_same_run(folder: RunFolder, config: RunConfig) -> None:
    """Refuse to go on with a run that was started with other settings.

    The stored configuration is compared with the present one and used for nothing else. If there is
    none, the present one is written.
    """
    now = {key: value for key, value in asdict(config).items() if key not in FREE}
    now["schedule"] = {k: v for k, v in now["schedule"].items() if k not in FREE_SCHEDULE}
    file, wrong = folder.path / "config.json", f"hydra.run.dir={folder.path}:"
    if not file.exists():
        # Tables here are no run's of ours, and a run begins by removing what is left of one.
        foreign = sorted([*folder.lengths(), *(p.name for p in folder.path.glob("checkpoints"))])
        if foreign:
            raise ConfigError(
                f"{wrong} holds {foreign[0]} but no config.json, so it is no run's folder; give "
                "another"
            )
        folder.write_json(file.name, now)
        return
    before = stored_config(file)
    if isinstance(before, dict) and (gone := before.keys() - now.keys()):
        raise ConfigError(
            f"{wrong} the run there was begun by another version, which had "
            f"{', '.join(sorted(gone))}; it can be read, but not gone on with"
        )
    differing = _different(before, now)
    if differing:
        key, (old, new) = next(iter(differing.items()))
        raise ConfigError(
            f"{key}={new!r:.80}: the run in {folder.path} was started with {old!r:.80}; "
            f"differing keys: {', '.join(differing)}"
        )


def as_begun(config: RunConfig, path: Path) -> RunConfig:
    """The settings, with what ``precision=auto`` was on the machine where the run was begun."""
    file = path / "config.json"
    if config.precision != "auto" or not file.is_file():
        return config
    match stored_config(file):
        case {"precision": ("fp32" | "bf16") as precision}:
            return replace(config, precision=precision)
    return config


def _different(before: Any, now: Any, prefix: str = "") -> dict[str, tuple[Any, Any]]:
    """Both values of every key that differs, by its dotted name."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return {} if before == now else {prefix.rstrip("."): (before, now)}
    return {
        name: values
        for key in sorted(before.keys() | now.keys())
        for name, values in _different(before.get(key), now.get(key), f"{prefix}{key}.").items()
    }
