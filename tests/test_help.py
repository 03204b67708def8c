"""``bin/train --help``: complete, at once, and about what there is."""

from __future__ import annotations

import re
import shlex
import subprocess
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
    section = help_text([]).partition(f"{file.parent.name}= ")[2].partition("\n\n")[0]
    assert file.stem in re.findall(r"[\w/]+", section)
    line = next(comments(file))
    assert len(line) > 10 and line.endswith(".")


def test_every_group_that_a_command_adds_is_listed() -> None:
    given = {folder.name for folder in CONFIG_FOLDER.iterdir() if folder.is_dir()}
    always = {"logger", "compute", "proposer"}  # docs/reference/configuration.md has these
    assert given - always == {group.strip("+=") for group in GROUPS}
    assert {"target", "perf_gain", "plr"} <= {file.stem for file in FILES}


def test_the_examples_are_valid() -> None:
    examples = re.findall(r"^  bin/train (\+.*|-m .*)$", help_text([]).split("Examples:")[1], re.M)
    assert len(examples) == 3
    for example in examples:
        overrides = [word for word in shlex.split(example, comments=True) if "=" in word]
        assert composed(*(word.partition(",")[0] for word in overrides)).method == "perf_gain"


def test_files_of_ones_own_are_listed(tmp_path: Path) -> None:
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "mine.yaml").write_text("# @package _global_\n# My own.\nmethod: mine\n")
    for option in (["--config-dir", str(tmp_path)], [f"--config-dir={tmp_path}"]):
        said = help_text([*option, "--help"])
        assert re.search(r"\bmine\b", said)
    assert not re.search(r"\bmine\b", help_text(["--help"]))


@pytest.mark.parametrize("arguments", [["--help"], ["+method=target", "-h"]])
def test_help_imports_nothing_that_takes_time(arguments: list[str], tmp_path: Path) -> None:
    code = (
        "import sys; from proposer_rl.cli.start import main; main(); "
        "assert not {'torch', 'hydra', 'pydantic'} & sys.modules.keys()"
    )
    ended = python(code, *arguments, path=CONFIG_FOLDER.parent, folder=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == help_text([]) + "\n"
    assert list(tmp_path.iterdir()) == []


def ends(command: str, *arguments: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """How a command of bin/ ends; the last line is what it imported that takes seconds."""
    code = (
        "import atexit, runpy, sys; "
        f"atexit.register(lambda: print(sorted({SLOW} & sys.modules.keys()))); "
        "runpy.run_module(sys.argv.pop(1), run_name='__main__')"
    )
    words = map(str, (*MODULES[command].split(), *arguments))
    return python(code, *words, path=CONFIG_FOLDER.parent, folder=folder)


@pytest.mark.parametrize("command", sorted(MODULES))
def test_no_commands_help_imports_what_takes_seconds(command: str, tmp_path: Path) -> None:
    ended = ends(command, "--help", folder=tmp_path)
    assert ended.returncode == 0 and command in ended.stdout, ended.stderr
    assert ended.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        *((command, ["nowhere"]) for command in ("report", "play", "watch")),
        ("eval", ["run", "--output", "rows.txt"]),
        *(("train", ["+method=target", key]) for key in ("sede=1", "solver.batchsize=1")),
        ("train", ["+method=magic"]),
    ],
)
def test_a_refused_argument_imports_nothing_that_takes_seconds(
    command: str, arguments: list[str], tmp_path: Path
) -> None:
    ended = ends(command, *arguments, folder=tmp_path)
    (line,) = ended.stderr.splitlines()
    name = arguments[-1].partition("=")[0].lstrip("+")
    assert ended.returncode == 2 and line.startswith("error: ") and name in line
    assert ended.stdout == "[]\n"
    assert list(tmp_path.iterdir()) == []
