"""The README's commands and code run as they are written, one after another in one folder."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from proposer_rl.cli.report import main as report
from proposer_rl.cli.train import main as train
from proposer_rl.cli.watch import main as watch
from tests.commands import LITTLE, call
from tests.committed import needs_results
from tests.tasks.gymnasium.toys import TINY

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROGRAMS = {"bin/train": train, "bin/report": report, "bin/watch": watch}


def blocks(language: str, text: str) -> list[str]:
    """The fenced blocks of a language."""
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)


def commands(text: str) -> list[list[str]]:
    """The words of every command in the page's bash blocks, in order."""
    lines = [line for block in blocks("bash", text) for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def write_files(text: str, folder: Path) -> list[Path]:
    """Writes the configuration files that a page shows, each after a line that ends in its path."""
    written = []
    for path, block in re.findall(r"`(my_conf/\S+)`:\n\n```yaml\n(.*?)```", text, re.DOTALL):
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(block, encoding="utf-8")
        written.append(file)
    return written


def smallest(words: list[str]) -> list[str]:
    """The same arguments of ``bin/train`` with those overrides that make a run of seconds."""
    small = [re.sub(r"^\+scale=.*", "+scale=smoke", word) for word in words]
    small = [re.sub(r"^(seed=\d+),.*", r"\1", word) for word in small]
    small = [re.sub(r"^(schedule\.updates=).*", r"\g<1>6", word) for word in small]
    if not any(word.startswith("schedule.updates=") for word in small):
        small.append("schedule.updates=3")
    if any(word.startswith("task=") for word in small):  # scales are of mazes
        return [*small, *TINY]
    scaled = any(word.startswith("+scale=") for word in small)
    return [*small, *([] if scaled else ["+scale=smoke"]), "compute.progress=false", *LITTLE]


def run(text: str) -> None:
    """Runs a page's commands as a reader would, in the working folder."""
    write_files(text, Path())
    for program, *words in commands(text):
        if program in PROGRAMS:
            words = smallest(words) if program == "bin/train" else words
            assert call(PROGRAMS[program], *words) == 0, (program, words)


def test_the_first_command_runs_the_papers_method_and_the_second_the_tests() -> None:
    first, second, *_ = commands(README)
    assert first == ["bin/train", "+method=perf_gain", "+scale=quick"]
    assert second == ["bin/test"]


@pytest.mark.usefixtures("own_folder")
def test_the_commands_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("proposer_rl.report.build.DRAWINGS", [])  # it is the words that are tested
    run(README)
    assert len(list(Path().glob("outputs/*/*/summary.json"))) == 3
    assert list(Path().glob("**/report.html"))


@pytest.mark.usefixtures("own_folder")
def test_the_code_runs_and_says_what_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    first, *others = blocks("python", README)
    names: dict[str, object] = {}
    exec(first, names)
    shown = re.search(r"^```\n({'target'.*?\n)```", README, re.MULTILINE)
    assert shown is not None and capsys.readouterr().out == shown[1]
    for block in others:
        exec(block, names)


@needs_results
def test_what_it_links_to_is_there() -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", README):
        assert (ROOT / target).is_file(), target
