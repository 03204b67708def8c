"""Completion in the shell and config folders, as docs/reference/configuration.md describes them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# What bash does at a press of Tab after LINE; the function is that of the command's last part.
PRESS_TAB = r"""
eval "$(bin/train -sc install=bash)"
complete -p train
COMP_LINE="$LINE" COMP_POINT=${#LINE} COMP_WORDS=($LINE) COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
hydra_bash_completion
echo "${COMPREPLY[@]}"
"""


def test_bash_completes_the_name_of_a_method(tmp_path: Path) -> None:
    command = tmp_path / "bin" / "train"  # starts Python as the repository's does
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m proposer_rl.cli.start "$@"\n')
    command.chmod(0o755)
    process = subprocess.run(
        ["bash", "-c", PRESS_TAB],
        cwd=tmp_path,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "LINE": "bin/train +method=perf"},
        capture_output=True,
        text=True,
        check=True,
    )
    registered, completed = process.stdout.splitlines()
    assert registered.startswith("complete ") and registered.endswith(" train")
    assert completed == "+method=perf_gain"


@pytest.mark.usefixtures("own_folder")
def test_a_config_folder_that_is_not_there_gets_one_line(train, capsys) -> None:
    assert train("--config-dir", "nowhere", "+method=target") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ") and "nowhere' not found" in line
