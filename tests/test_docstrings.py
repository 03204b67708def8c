"""The examples in docstrings show what really comes out."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import proposer_rl

PACKAGE = Path(proposer_rl.__file__).parent
MODULES = [
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]

# What somebody who lifts a part into code of their own looks at first.
SHOWN = [
    proposer_rl.generate_levels,
    proposer_rl.shortest_path_length,
    proposer_rl.Level.from_text,
    proposer_rl.MazeEnv,
    proposer_rl.UNet,
    proposer_rl.Population,
    proposer_rl.PPO,
    proposer_rl.ExactEvaluator,
    proposer_rl.performance_gain,
    proposer_rl.LeaveOneOutBaseline,
    proposer_rl.Mixture,
    proposer_rl.ProblemChoices,
    proposer_rl.Streams,
]


@pytest.mark.parametrize("module", MODULES)
def test_the_examples_are_true(module: str, capsys: pytest.CaptureFixture[str]) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0, capsys.readouterr().out


@pytest.mark.parametrize("thing", SHOWN, ids=lambda thing: thing.__name__)
def test_the_main_parts_have_an_example(thing: object) -> None:
    assert ">>> " in str(thing.__doc__)
