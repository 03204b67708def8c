"""The line that a command prints where a package is missing, and what pip makes of it."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest

from proposer_rl import extras
from proposer_rl.extras import install_command
from tests.test_packaging import PROJECT, ROOT

EXTRAS = PROJECT["optional-dependencies"]
CALL = re.compile(r"install_command\(([^)]*)\)|require_package\(\s*[^,()]+, ([^,)]+)")


def test_only_extras_that_there_are_are_asked_for() -> None:
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "proposer_rl").rglob("*.py")]
    asked = {"".join(names) for source in sources for names in CALL.findall(source)}
    named = {name.strip("\"'") for name in asked if name[0] in "\"'"}
    assert named == {"alp-gmm", "play", "ray"}
    # The others are definitions, the logger's, whose extra has its name, and a setting of tasks.
    others = {name for name in asked if name[0] not in "\"'"}
    assert others == {"extra: str", "config.logger.type", "extra"}
    assert named | {"tensorboard", "wandb"} <= EXTRAS.keys()


@pytest.mark.parametrize("extra", EXTRAS)
def test_of_a_checkout_the_line_installs_it_with_the_extra(extra: str) -> None:
    command = shlex.split(install_command(extra))
    assert command[:4] == [sys.executable, "-m", "pip", "install"]
    assert command[4:] == ["-c", str(ROOT / "constraints.txt"), "-e", f"{ROOT}[{extra}]"]


def test_of_an_installed_package_the_line_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "ROOT", tmp_path)
    command = shlex.split(install_command("alp-gmm"))
    assert command == [sys.executable, "-m", "pip", "install", "proposer_rl[alp-gmm]"]
