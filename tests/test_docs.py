"""What the pages in docs/ show works as it is written; the site itself is a stage of bin/test."""

from __future__ import annotations

import argparse
import doctest
import functools
import importlib.util
import json
import operator
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

import proposer_rl as prl
from proposer_rl.cli.eval import main as evaluate
from proposer_rl.cli.groups import arranged
from proposer_rl.cli.help import needs
from proposer_rl.recipes import CONFIG_FOLDER, composed, maker
from proposer_rl.settings import check_names, schema
from tests.commands import SMOKE, call, trained_run
from tests.committed import needs_results
from tests.test_bin import MODULES
from tests.test_readme import DOCS, README, ROOT, blocks, commands, run, smallest, write_files

PAGES = {
    str(file.relative_to(DOCS).with_suffix("")): file.read_text(encoding="utf-8")
    for file in sorted(DOCS.rglob("*.md"))
    if file.parts[len(DOCS.parts)] != "api"
}
# A block of code, and its output if a block without a language follows.
OUTPUT = r"^```python\n(.*?)^```$(?:\n\n^```\n(.*?)^```$)?"
CONFIGURATION, LEVELS = PAGES["reference/configuration"], PAGES["how_to/levels"]


def shown() -> Iterator[tuple[str, tuple[str, ...]]]:
    """Program and arguments of every command in a block or in a line, executed here or not."""
    for text in (README, *PAGES.values()):
        lines = [line.strip() for block in blocks("(?:bash)?", text) for line in block.splitlines()]
        for line in (*lines, *re.findall("`(bin/[^`]+)`", text)):
            command = re.match(r"(?:bin/|proposer-)(\w+) ?", line)
            words = shlex.split(line[command.end() :], comments=True) if command else []
            if command and words and not re.search("NAME|<TAB>|-sc ", line):
                yield command[1], tuple(words)


def settings(words: tuple[str, ...]) -> tuple[str, ...]:
    """Of the arguments of a run those that differ in more than seeds, folders and flags."""
    return tuple(w for w in words if "=" in w and not re.match(r"'?(seeds?|hydra\.\w+\.dir)=", w))


TRAIN = sorted({words for program, words in shown() if program == "train"})
SETTINGS = {(settings(words), "--config-dir" in words) for words in TRAIN}
OTHERS = sorted({(program, words) for program, words in shown() if program != "train"})


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize("page", [page for page, text in PAGES.items() if blocks("python", text)])
def test_the_code_runs_and_says_what_is_shown(
    page: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The blocks of a page one after another, as a reader would type them."""
    names: dict[str, object] = {}
    for code, shown in re.findall(OUTPUT, PAGES[page], re.DOTALL | re.MULTILINE):
        exec(code, names)
        assert capsys.readouterr().out.endswith(shown)


def test_the_settings_exist(tmp_path: Path) -> None:
    """Every key and group of every bin/train in the pages, also of those that no test executes."""
    for text in (README, *PAGES.values()):
        write_files(text, tmp_path)
    assert len(SETTINGS) > 40
    for words, own in sorted(SETTINGS):
        words = [
            word.replace("checkpoint=", "+checkpoint=") for word in words if "/job" not in word
        ]
        overrides = [
            override.input_line
            if not override.is_sweep_override()
            else f"{override.input_line.partition('=')[0]}={next(override.sweep_string_iterator())}"
            for override in OverridesParser.create().parse_overrides(list(words))
        ]
        if own:
            overrides.append(f"hydra.searchpath=[file://{tmp_path / 'my_conf'}]")
        GlobalHydra.instance().clear()
        with initialize_config_dir(str(CONFIG_FOLDER), version_base="1.3"):
            config = compose("train", arranged(overrides), return_hydra_config=True)
        if config.curriculum is not None:
            make, _ = maker("curriculum", {"_target_": config.curriculum["_target_"]})
            own = {name: None for name in config.curriculum if name != "_target_"}
            check_names(schema(make), own, missing=False)


class Parsed(Exception):
    """The arguments were understood, and nothing has been done yet."""


@pytest.mark.parametrize(("program", "arguments"), OTHERS)
def test_the_arguments_are_understood(
    program: str, arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    if program not in MODULES:  # in the shell: bin/test, which takes pytest's, and bin/docs
        assert (ROOT / "bin" / program).is_file()
        return
    parse = argparse.ArgumentParser.parse_args

    def parse_only(self: argparse.ArgumentParser, *given: object) -> None:
        parse(self, *given)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    module, *first = MODULES[program].split()
    monkeypatch.setattr(sys, "argv", [f"bin/{program}", *first, *arguments])
    main = importlib.import_module(
        f"{module}.__main__" if (ROOT / module.replace(".", "/")).is_dir() else module
    ).main
    with pytest.raises(Parsed):
        main()


@pytest.mark.usefixtures("own_folder")
@pytest.mark.parametrize("page", ["how_to/resume", "how_to/reuse_a_proposer"])
def test_the_commands_run(page: str) -> None:
    """The pages whose commands build on one another; other pages' settings are composed above."""
    run(
        PAGES[page].replace(
            "+scale=medium checkpoint=results/medium/proposer.pt", "checkpoint=learned"
        )
    )
    assert list(Path().rglob("summary.json"))


@pytest.mark.usefixtures("own_folder")
def test_the_config_folder_of_ones_own_works(train: Callable[..., int]) -> None:
    assert len(write_files(CONFIGURATION, Path())) == len(blocks("yaml", CONFIGURATION)) == 1
    own = [words for _, *words in commands(CONFIGURATION) if "--config-dir" in words]
    for words in own:
        assert train(*smallest(words)) == 0
    assert len(list(Path().glob("outputs/*/*/summary.json"))) == sum("-m" not in w for w in own)
    assert len(list(Path().glob("multirun/*/*/summary.json"))) == 2
    # What a reader of the report is told of it, and what the command needs beside its settings.
    facts = json.loads(next(Path().glob("outputs/*/*/run.json")).read_text(encoding="utf-8"))
    assert facts["arguments"]["config_dir"] == "my_conf" and facts["about"]["method"]


@pytest.mark.usefixtures("own_folder")
def test_settings_can_be_looked_at(
    train: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    looks = [words for _, *words in commands(CONFIGURATION) if {"--cfg", "--info"} & set(words)]
    assert looks
    for words in looks:
        assert train(*words) == 0
        said = capsys.readouterr()
        assert said.err == ""
        if words[-1] == "searchpath":
            assert str(CONFIG_FOLDER) in said.out
        if words[-1] == "job":
            assert "method: perf_gain" in said.out and "scale: quick" in said.out
    assert not list(Path().rglob("*"))


@pytest.mark.usefixtures("own_folder")
def test_the_commands_about_levels_run() -> None:
    """On a Solver of a few updates, and with the file of levels that the page shows."""
    (drawn,) = blocks("text", LEVELS)
    Path("my_levels.txt").write_text(drawn)
    trained_run(Path("my_run"), "+method=target", *SMOKE)
    for program, *words in commands(LEVELS):
        assert program == "bin/eval" and call(evaluate, *words) == 0, words
    assert Path("scores.csv").is_file()


@needs_results
def test_pages_link_to_what_is_there() -> None:
    """Sphinx checks links within the site; this, those to files outside of it."""
    for page, text in PAGES.items():
        for target in re.findall(r"\]\(((?:\.\./)+[^)#]+)\)", text):
            assert (DOCS / page).parent.joinpath(target).is_file(), f"{page}.md: {target}"


def test_the_names_of_the_api_are_there() -> None:
    """Each where the page says it is, and all that loops of one's own need."""
    rows = [line for line in PAGES["api"].splitlines() if line.startswith("| ")][1:]
    names = {name for row in rows for name in re.findall(r"`([\w.]+)", row)}
    assert len(names) > 40
    for name in names:
        module, _, last = f"proposer_rl.{name}".rpartition(".")
        found = hasattr(importlib.import_module(module), last)
        assert found or importlib.util.find_spec(f"proposer_rl.{name}"), name
    assert {*dir(prl)} & {*vars(importlib.import_module("proposer_rl.teaching"))} <= names


def test_every_example_is_on_the_site() -> None:
    text = PAGES["how_to/examples"]
    shown = set(re.findall(r"^```\{literalinclude\} \.\./\.\./(\S+)$", text, re.MULTILINE))
    files = [*(ROOT / "examples").rglob("*.py"), *(ROOT / "examples").rglob("*.yaml")]
    assert shown == {str(path.relative_to(ROOT)) for path in files}


def test_the_reference_says_of_each_method_what_its_file_says_that_it_needs() -> None:
    rows = [line.split(" | ") for line in PAGES["reference/methods"].splitlines()]
    cells = {name: row[2] for row in rows for name in re.findall(r"^\| \[?`(\w+)`", row[0])}
    for name, needs_of in needs([CONFIG_FOLDER]).items():
        for word in ("target", "exact evaluation", "gradients", "schedule", "items"):
            assert (word in cells[name]) == (word in " ".join(needs_of)), (name, word)


@pytest.mark.parametrize("page", ["reference/configuration", "how_to/resume"])
def test_the_reference_has_the_defaults(page: str) -> None:
    config = OmegaConf.to_container(composed(["method=perf_gain"]), resolve=True)
    for keys, defaults in re.findall(r"^\| (`[a-z].*?`) \| (\S.*?) \| ", PAGES[page], re.MULTILINE):
        first, *others = re.findall("`([^`]+)`", keys)
        names = [first, *(first.rpartition(".")[0] + other for other in others)]
        values = defaults.replace("`", "").split(", ")
        if len(values) == len(names) and not re.search(r"\*|^hydra", first):
            for name, value in zip(names, values, strict=True):
                found = functools.reduce(operator.getitem, name.split("."), config)
                assert str(found).replace("None", "null") == value, name


def test_every_method_scale_task_and_sweep_is_in_the_reference() -> None:
    names = set(re.findall(r"`(?:\+?\w+=)?(\w+)`", PAGES["reference/methods"]))
    for group in ("method", "scale", "task", "sweep", "as", "filter", "score"):
        files = {file.stem for file in (CONFIG_FOLDER / group).glob("*.yaml")}
        assert {name for name in files - names if not name.endswith("_accel")} == set(), group


DOCTESTED = [
    ".".join(file.relative_to(ROOT).with_suffix("").parts)
    for file in sorted((ROOT / "proposer_rl").rglob("*.py"))
    if ">>> " in file.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("module", DOCTESTED)
def test_the_examples_in_docstrings_are_true(
    module: str, capsys: pytest.CaptureFixture[str]
) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0, capsys.readouterr().out
