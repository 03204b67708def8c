"""The scripts of bin/ start their modules from any folder, also through links to them."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

BIN = Path(__file__).resolve().parents[1] / "bin"
STARTED = re.compile(r'^exec "\$PYTHON" -m (\S+) "\$@"$', re.MULTILINE)
MODULES = {
    file.name: started[1]
    for file in sorted(BIN.iterdir())
    if (started := STARTED.search(file.read_text(encoding="utf-8")))
}
# A python3 with everything installed that tells how it is called.
PYTHON = """\
#!/bin/sh
if [ "$1" = -E ]; then echo installed; else printf '%s\\n' "$PYTHONPATH" "$PWD" "$@"; fi
"""


@pytest.fixture
def python(tmp_path: Path) -> dict[str, str]:
    """The variables of a shell in which that python3 comes first."""
    (tmp_path / "path").mkdir()
    file = tmp_path / "path" / "python3"
    file.write_text(PYTHON)
    file.chmod(0o755)
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return kept | {"PATH": f"{file.parent}:{kept['PATH']}"}


def test_they_are_all_there() -> None:
    assert {"bench", "eval", "look", "report", "snr", "train", "watch"} <= MODULES.keys()
    assert all(os.access(file, os.X_OK) for file in BIN.iterdir() if file.name != "_environment")


@pytest.mark.parametrize("name", MODULES)
def test_they_start_their_modules_through_links(
    name: str, python: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "a folder").mkdir()
    (tmp_path / "absolute").symlink_to(BIN / name)
    (tmp_path / "a folder" / "relative").symlink_to(Path("..", "absolute"))
    for called in (BIN / name, Path("absolute"), Path("a folder", "relative")):
        ended = subprocess.run(
            [tmp_path / called, "--help", "two words"],
            cwd=tmp_path,
            env=python,
            capture_output=True,
            text=True,
            check=True,
        )
        expected = [BIN.parent, tmp_path, "-m", MODULES[name], "--help", "two words"]
        assert ended.stdout.splitlines() == [str(part) for part in expected]


@pytest.mark.parametrize(
    ("held", "asked", "enough"),
    [
        ("", "", True),
        ("", "docs", False),
        ("docs", "", True),
        ("docs", "docs", True),
        ("docs", "dev", False),
        ("dev", "docs", True),
        ("dev", "dev", True),
    ],
)
def test_an_environment_is_added_to_only_where_something_is_missing(
    held: str, asked: str, enough: bool, tmp_path: Path
) -> None:
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "python").symlink_to("/bin/sh")
    (tmp_path / "stamp").write_text(f"hash {held}\n")
    places = f'VENV="{tmp_path}" STAMP="{tmp_path}/stamp"'
    for known in ("hash", "other"):
        script = f'. "{BIN}/_environment"; {places}; up_to_date {known} {asked}'
        done = subprocess.run(["bash", "-c", script], check=False)
        assert (done.returncode == 0) == (enough and known == "hash")


def test_the_site_needs_only_its_own_extra() -> None:
    assert "use_environment docs\n" in (BIN / "docs").read_text(encoding="utf-8")
    assert "use_environment dev\n" in (BIN / "test").read_text(encoding="utf-8")
