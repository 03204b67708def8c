"""Where the package and its configuration lie; imports nothing that takes time."""

from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
# In a wheel the configuration lies in the package, in a checkout beside it.
CONFIG_FOLDER = next(
    (folder for folder in (PACKAGE / "conf", PACKAGE.parent / "conf") if folder.is_dir()),
    PACKAGE / "conf",
)


def names(folder: Path, group: str) -> list[str]:
    """What a configuration folder has to choose from in a group such as ``method``."""
    return sorted(file.stem for file in (folder / group).glob("*.yaml"))
