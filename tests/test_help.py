"""``bin/train --help``: complete, at once, and about what there is."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from proposer_rl.cli.help import GROUPS, help_text
from proposer_rl.recipes import CONFIG_FOLDER, comments
from tests.processes import python
from tests.test_bin import MODULES
from tests.tiny import composed

SLOW = {"torch", "matplotlib", "plotly", "scipy"}
FILES = [
    file for group in GROUPS for file in sorted((CONFIG_FOLDER / group.strip("+=")).glob("*.yaml"))
]


@pytest.mark.parametrize("file", FILES, ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_every_choice_is_listed_and_has_a_line_for_reports(file: Path) -> None:
    section = help_text().partition(f"{file.parent.name}= ")[2].partition("\n\n")[0]
    assert file.stem in re.findall(r"[\w/]+", section)
    line = next(comments(file))
    assert len(line) > 10 and line.endswith(".")


def test_every_group_that_a_command_adds_is_listed() -> None:
    given = {folder.name for folder in CONFIG_FOLDER.iterdir() if folder.is_dir()}
    always = {"logger", "compute", "proposer"}  # docs/reference/configuration.md has these
    assert given - always == {group.strip("+=") for group in GROUPS}
    assert {"target", "perf_gain", "plr"} <= {file.stem for file in FILES}


def test_the_examples_are_valid() -> None:
    examples = re.findall(r"^  bin/train (\+.*|-m .*)$", help_text().split("Examples:")[1], re.M)
    assert len(examples) == 3
    for example in examples:
        overrides = [word for word in shlex.split(example, comments=True) if "=" in word]
        assert composed(*(word.partition(",")[0] for word in overrides)).method == "perf_gain"


@pytest.mark.parametrize("arguments", [["--help"], ["+method=target", "-h"]])
def test_help_imports_nothing_that_takes_time(arguments: list[str], tmp_path: Path) -> None:
    code = (
        "import sys; from proposer_rl.cli.start import main; main(); "
        "assert not {'torch', 'hydra', 'pydantic'} & sys.modules.keys()"
    )
    ended = python(code, *arguments, path=CONFIG_FOLDER.parent, folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == help_text() + "\n"
    assert list(tmp_path.iterdir()) == []


# Calls commands one after another, each as its words; none may import what takes seconds.
CALLS = f"""
import json, runpy, sys
for module, *words in json.loads(sys.argv[1]):
    sys.argv = ["command", *words]
    code = 0
    try:
        runpy.run_module(module, run_name="__main__")
    except SystemExit as end:
        code = end.code or 0
    print("ended with", code, *words, {SLOW} & sys.modules.keys(), flush=True)
"""


def ends(*commands: list[str], folder: Path) -> tuple[list[str], list[str]]:
    """How commands of bin/ end that are called in one fresh interpreter, and what they refuse."""
    calls = [[*MODULES[command].split(), *words] for command, *words in commands]
    said = python(CALLS, json.dumps(calls), path=CONFIG_FOLDER.parent, folder=folder)
    assert list(folder.iterdir()) == []
    endings = [line for line in said.stdout.splitlines() if line.startswith("ended with")]
    return endings, said.stderr.splitlines()


def test_no_commands_help_imports_what_takes_seconds(tmp_path: Path) -> None:
    endings, refused = ends(*([command, "--help"] for command in MODULES), folder=tmp_path)
    assert len(endings) == len(MODULES) and refused == []
    assert all(re.fullmatch(r"ended with 0 .*--help set\(\)", line) for line in endings)


def test_a_refused_argument_imports_nothing_that_takes_seconds(tmp_path: Path) -> None:
    words = [[command, "nowhere"] for command in ("report", "play", "watch")]
    words += [["eval", "run", "--output", "rows.txt"], ["train", "+method=magic"]]
    words += [["train", "+method=target", key] for key in ("sede=1", "solver.batchsize=1")]
    endings, refused = ends(*words, folder=tmp_path)
    assert len(endings) == len(refused) == len(words)
    for (*_, word), ending, line in zip(words, endings, refused, strict=True):
        assert ending.startswith("ended with 2 ") and ending.endswith(f"{word} set()")
        assert line.startswith("error: ") and word.partition("=")[0].lstrip("+") in line


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
        env={
            "PATH": "/usr/bin:/bin",
            "PYTHONPATH": str(CONFIG_FOLDER.parent),
            "LINE": "bin/train +method=perf",
        },
        capture_output=True,
        text=True,
        check=True,
    )
    registered, completed = process.stdout.splitlines()
    assert registered.startswith("complete ") and registered.endswith(" train")
    assert completed == "+method=perf_gain"
