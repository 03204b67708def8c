"""What the README shows works as it is written."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from proposer_rl.cli.train import main

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands() -> list[list[str]]:
    lines = [line for block in blocks("bash") for line in block.splitlines()]
    calls = [shlex.split(line, comments=True) for line in lines]
    return [call[1:] for call in calls if call and call[0] == "bin/train"]


def test_the_code_runs() -> None:
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(block, names)
    assert {"rollout", "snapshot"} <= names.keys()


@pytest.mark.parametrize("arguments", commands(), ids=" ".join)
def test_the_commands_run(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each command at the smallest scale: it is the words that are tested here."""
    small = [re.sub(r"^\+scale=.*", "+scale=smoke", word) for word in arguments]
    if "+scale=smoke" not in small:
        small.append("+scale=smoke")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["bin/train", *small])
    GlobalHydra.instance().clear()
    main()
    assert list(tmp_path.rglob("summary.json"))


def test_the_files_that_it_shows_exist() -> None:
    root = Path(__file__).parents[1]
    for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README):
        assert (root / target).is_file(), target
