"""The scripts of bin/ start their modules from any folder, also through links to them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

BIN = Path(__file__).resolve().parents[1] / "bin"
STARTED = re.compile(r'^exec "\$PYTHON" -m (\S.*) "\$@"$', re.MULTILINE)
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
    assert {"bench", "eval", "play", "report", "research", "train", "watch"} <= MODULES.keys()
    assert all(os.access(file, os.X_OK) for file in BIN.iterdir() if file.name != "_environment")


@pytest.mark.parametrize("name", MODULES)
def test_they_start_their_modules_through_links(
    name: str, python: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "a folder").mkdir()
    (tmp_path / "absolute").symlink_to(BIN / name)
    (tmp_path / "a folder" / "relative").symlink_to(Path("..", "absolute"))
    ended = subprocess.run(
        [tmp_path / "a folder" / "relative", "--help", "two words"],
        cwd=tmp_path,
        env=python,
        capture_output=True,
        text=True,
        check=True,
    )
    expected = [BIN.parent, tmp_path, "-m", *MODULES[name].split(), "--help", "two words"]
    assert ended.stdout.splitlines() == [str(part) for part in expected]


# A python3 of a machine without proposer_rl: it makes environments of itself, and tells what pip is
# asked for.
BARE = """\
#!/bin/sh
case "$1 $2 $3" in
  -E*) echo a-hash ;;
  "-m venv "*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
  "-m pip --version") [ "$(basename "$0")" = python ] ;;
  "-m pip install") for last; do :; done; [ "$last" = 'pip>=25' ] || echo "$last" >> "$PIP_LOG" ;;
  "-m proposer_rl"*) echo "${PYTHONDONTWRITEBYTECODE-none} ${PYTHONPYCACHEPREFIX-none}" ;;
esac
"""


@pytest.fixture
def bare(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """A checkout on that machine, and the variables of a shell there."""
    root, folder = tmp_path / "checkout", tmp_path / "path"
    shutil.copytree(BIN, root / "bin")
    (root / "constraints.txt").touch()
    folder.mkdir()
    (folder / "python3").write_text(BARE)
    (folder / "python3").chmod(0o755)
    set_here = ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX")
    kept = {key: value for key, value in os.environ.items() if key not in set_here}
    path = f"{folder}:{kept['PATH']}"
    return root, kept | {"PATH": path, "PIP_LOG": str(tmp_path / "pip")}


def test_environments_keep_the_extras_that_they_have(bare: tuple[Path, dict[str, str]]) -> None:
    root, environment = bare
    log = Path(environment["PIP_LOG"])
    asked = []
    for command in ("report", "play", "docs", "report", "play", "test", "play", "docs", "train"):
        log.write_text("")
        subprocess.run([root / "bin" / command], env=environment, capture_output=True, check=True)
        asked.append(log.read_text().strip())
    extras = ["", "[play]", "[play,docs]", None, None, "[play,docs,dev]", None, None, None]
    assert asked == ["" if extra is None else f"{root}{extra}" for extra in extras]


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, "none none"),
        ({"PYTHONDONTWRITEBYTECODE": "1"}, "none {root}/.venv/bytecode"),
        ({"PYTHONDONTWRITEBYTECODE": "1", "PYTHONPYCACHEPREFIX": "/own"}, "none /own"),
    ],
)
def test_bytecode_that_may_not_lie_beside_sources_is_kept_elsewhere(
    variables: dict[str, str], expected: str, bare: tuple[Path, dict[str, str]]
) -> None:
    root, environment = bare
    ended = subprocess.run(
        [root / "bin" / "report"],
        env=environment | variables,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stdout.strip() == expected.format(root=root)


def test_a_checkout_that_others_may_only_read_says_who_renews_its_environment(
    bare: tuple[Path, dict[str, str]],
) -> None:
    root, environment = bare
    (root / ".venv").mkdir()
    (root / ".venv").chmod(0o555)
    command: list[str | Path] = [root / "bin" / "train"]
    if os.geteuid() == 0:  # who may write everywhere
        if not shutil.which("setpriv"):
            pytest.skip("root can be no other user without setpriv")
        for folder in root.parents:
            if folder.owner() == "root" and folder != Path("/"):
                folder.chmod(folder.stat().st_mode | 0o055)
        command = ["setpriv", "--reuid=12345", "--regid=12345", "--clear-groups", *command]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    (line,) = ended.stderr.splitlines()
    assert ended.returncode == 1 and "is not up to date with pyproject.toml" in line
    assert f"its owner, {root.owner()}, renews it" in line


def test_the_site_needs_only_its_own_extra() -> None:
    assert "use_environment docs\n" in (BIN / "docs").read_text(encoding="utf-8")
    assert "use_environment dev\n" in (BIN / "test").read_text(encoding="utf-8")


# A python3 with everything installed that says which module is to run, and which may fail.
STAGES = """\
#!/bin/sh
case "$*" in
  -E*) echo installed ;;
  "-m $FAILING"*) echo "bad $FAILING"; exit 3 ;;
  "-m "*) echo "ran $2" ;;
esac
"""


STAGES_IN_ORDER = {
    "format": "ruff", "lint": "ruff", "tests": "pytest", "types": "mypy", "docs": "sphinx"
}  # fmt: skip


@pytest.mark.parametrize("failing", ["ruff", "sphinx", "pytest", "nothing"])
def test_a_stage_that_fails_gives_its_status(failing: str, tmp_path: Path) -> None:
    """Without format and lint nothing else begins; the others run side by side."""
    file = tmp_path / "python3"
    file.write_text(STAGES)
    file.chmod(0o755)
    environment = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "FAILING": failing}
    ended = subprocess.run(
        [BIN / "test"], env=environment, capture_output=True, text=True, check=False
    )
    expected = []
    for stage, module in STAGES_IN_ORDER.items():
        expected += [f"== {stage}", f"{'bad' if module == failing else 'ran'} {module}"]
    assert ended.stdout.splitlines() == (expected[:2] if failing == "ruff" else expected)
    assert ended.returncode == (0 if failing == "nothing" else 3)


def test_ci_ends_with_the_tests_whatever_they_leave_behind(tmp_path: Path) -> None:
    (tmp_path / ".ci").mkdir()
    (tmp_path / "bin").mkdir()
    shutil.copy(BIN.parent / ".ci" / "run", tmp_path / ".ci")
    script = (
        '#!/bin/sh\n[ "$1" = --version ] && exit\nsleep 20 &\necho "1 failed in 2.00s"\nexit 3\n'
    )
    for name in ("test", "chromium"):
        (tmp_path / "bin" / name).write_text(script)
        (tmp_path / "bin" / name).chmod(0o755)
    path = {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    ended = subprocess.run(
        [tmp_path / ".ci" / "run"],
        env=os.environ | path,
        capture_output=True,
        text=True,
        timeout=15,
        check=False,
    )
    assert ended.returncode == 3
    assert ended.stdout.splitlines() == ["1 failed in 2.00s"] * 2
