"""What the pages in docs/ show works as it is written; the site itself is a stage of bin/test."""

from __future__ import annotations

import argparse
import importlib
import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser

from proposer_rl.cli.config import CONFIG_FOLDER
from tests.test_readme import DOCS, README, blocks

ROOT = DOCS.parent
PAGES = {file.stem: file.read_text(encoding="utf-8") for file in sorted(DOCS.glob("*.md"))}
CODE = [page for page, text in PAGES.items() if blocks("python", text)]


def programs() -> dict[str, list[str]]:
    """The module behind every command of bin/ that is a Python program, and its first arguments."""
    found = {}
    for file in (ROOT / "bin").iterdir():
        started = re.search(r'-m ((?:proposer_rl|research).*) "', file.read_text(encoding="utf-8"))
        if started:
            found[file.name] = started[1].split()
    return found


def commands() -> Iterator[tuple[str, str, tuple[str, ...]]]:
    """Page, program and arguments of every command in a block, executed by a test or not."""
    for page, text in {"README": README, **PAGES}.items():
        for language, block in re.findall(
            r"^```(\S*).*?\n(.*?)^```", text, re.DOTALL | re.MULTILINE
        ):
            for line in block.splitlines() if language in ("", "bash") else ():
                command = line.startswith(("bin/", "proposer-"))
                words = shlex.split(line, comments=True) if command else []
                called = re.fullmatch(r"(?:bin/|proposer-)(\w+)", words[0]) if words else None
                if called:
                    yield page, called[1], tuple(words[1:])


TRAIN = sorted({call for _, program, call in commands() if program == "train"})
OTHERS = sorted({(program, call) for _, program, call in commands() if program != "train"})


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize("page", CODE)
def test_the_code_runs(page: str) -> None:
    """The blocks of a page one after another, as a reader would type them."""
    names: dict[str, object] = {}
    for block in blocks("python", PAGES[page]):
        exec(block, names)


@pytest.mark.parametrize("arguments", TRAIN, ids=" ".join)
def test_the_settings_exist(arguments: tuple[str, ...], tmp_path: Path) -> None:
    """Every key and group of every bin/train in the pages, also of those that no test executes."""
    write_files(tmp_path)
    words = [word for word in arguments if "=" in word]
    overrides = [
        override.input_line
        if not override.is_sweep_override()
        else f"{override.input_line.partition('=')[0]}={next(override.sweep_string_iterator())}"
        for override in OverridesParser.create().parse_overrides(words)
        if "glob(" not in override.input_line
    ]
    if "--config-dir" in arguments:
        overrides.append(f"hydra.searchpath=[file://{tmp_path / 'my_conf'}]")
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
        compose("train", overrides, return_hydra_config=True)


class Parsed(Exception):
    """The arguments were understood, and nothing has been done yet."""


@pytest.mark.parametrize(("program", "arguments"), OTHERS)
def test_the_arguments_are_understood(
    program: str, arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    if program not in programs():  # in the shell: bin/test, which takes pytest's, and bin/docs
        assert (ROOT / "bin" / program).is_file()
        return
    parse = argparse.ArgumentParser.parse_args

    def parse_only(self: argparse.ArgumentParser, *given: object) -> None:
        parse(self, *given)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    module, *first = programs()[program]
    monkeypatch.setattr(sys, "argv", [f"bin/{program}", *first, *arguments])
    main = importlib.import_module(
        f"{module}.__main__" if (ROOT / module.replace(".", "/")).is_dir() else module
    ).main
    with pytest.raises(Parsed):
        main()


def write_files(folder: Path) -> list[Path]:
    """Writes the files that two pages show, each after a line that ends in its path."""
    written = []
    for page in ("configuration", "your_gymnasium_environment"):
        shown = re.findall(r"`(my_conf/\S+)`:\n\n```yaml\n(.*?)```", PAGES[page], re.DOTALL)
        assert len(shown) == len(blocks("yaml", PAGES[page]))
        for path, block in shown:
            file = folder / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block, encoding="utf-8")
            written.append(file)
    return written


@pytest.mark.usefixtures("own_folder")
def test_the_config_folder_of_ones_own_works(train) -> None:
    assert len(write_files(Path())) == 4
    own = [call for call in TRAIN if "--config-dir" in call and "task=hill" not in call]
    assert own
    for call in own:
        words = ["+scale=smoke" if word == "+scale=quick" else word for word in call]
        assert train(*words, "compute.progress=false") == 0
    folders = sorted(path.parent.name for path in Path().glob("outputs/*/*/summary.json"))
    assert len(folders) == sum("-m" not in call for call in own)
    assert len(list(Path().glob("multirun/*/*/summary.json"))) == 2
    # What a reader of the report is told of it, and what the command needs beside its settings.
    facts = json.loads(next(Path().glob("outputs/*/*/run.json")).read_text(encoding="utf-8"))
    given = own[0][own[0].index("--config-dir") + 1]
    assert facts["arguments"]["config_dir"] == given and facts["about"]["method"]


@pytest.mark.usefixtures("own_folder")
def test_settings_can_be_looked_at(train, capsys: pytest.CaptureFixture[str]) -> None:
    looks = [call for call in TRAIN if {"--cfg", "--info"} & set(call)]
    assert looks
    for call in looks:
        assert train(*call) == 0
        said = capsys.readouterr()
        assert said.err == ""
        if call[-1] == "searchpath":
            assert str(CONFIG_FOLDER) in said.out
        if call[-1] == "job":
            assert "method: perf_gain" in said.out and "scale: quick" in said.out
    assert not list(Path().rglob("*"))


def test_pages_link_to_what_is_there() -> None:
    """Sphinx checks links within the site; this, those to files outside of it."""
    for page, text in PAGES.items():
        for target in re.findall(r"\]\((\.\./[^)#]+)\)", text):
            assert (DOCS / target).is_file(), f"{page}.md: {target}"


def test_every_example_is_on_the_site() -> None:
    shown = set(re.findall(r"^```\{literalinclude\} \.\./(\S+)$", PAGES["examples"], re.MULTILINE))
    files = [*(ROOT / "examples").rglob("*.py"), *(ROOT / "examples").rglob("*.yaml")]
    assert shown == {str(path.relative_to(ROOT)) for path in files}
    for name in re.findall(r"\]\(examples\.md#(\w+)\)", PAGES["own_parts"]):
        assert f"## `{name.removesuffix('py')}.py`" in PAGES["examples"]
