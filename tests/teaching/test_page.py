"""The page says of each curriculum what the code asks for."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

import proposer_rl as prl
from proposer_rl.recipes import available

PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "own_loop.md"
TABLE = PAGE.read_text(encoding="utf-8").partition("## What each curriculum needs")[2]
CURRICULA, _, FUNCTIONS = TABLE.partition("| function |")
LINES = [line.split("|")[1:-1] for line in CURRICULA.splitlines() if line.startswith("| `")]
OPTIONAL = {re.findall(r"`(.+?)`", cells[0])[0] for cells in LINES if "perhaps" in cells[1]}
ROWS = {
    name: [*(re.findall(r"\w+", cell.replace("perhaps", "")) for cell in cells[1:4])]
    for cells in LINES
    for name in re.findall(r"`(.+?)`", cells[0])
}
NUMBERS = prl.LevelGenerator(lambda n, g: torch.rand(n, generator=g))
ITEMS = prl.Items(2, features=["add", "times"], pass_rates=[0.1, 0.9])
RANGES = prl.Parameters({"gravity": (0.0, 1.0)}, target={"gravity": 1.0}, named={"easy": {}})


class Able(prl.Student):
    """One that can do everything, and does nothing."""

    def lacks(self, name: str) -> None:
        return None


@pytest.mark.parametrize("row", ROWS)
def test_the_table_is_that_of_the_code(row: str) -> None:
    told, functions, space = ROWS[row]
    name, _, settings = row.partition("(")
    recipe = getattr(prl.curricula, name)
    given: Any = dict(re.findall(r'(\w+)="(\w+)"', settings))
    if name == "hand_designed":
        given = {"distributions": ["easy"], "until": []}
    teacher = prl.Teacher(recipe(**given), ITEMS if "items" in space else RANGES, student=Able())
    curriculum = teacher.curriculum
    assert [*curriculum.required_results, *curriculum.optional_results] == told
    assert bool(curriculum.optional_results) == (row in OPTIONAL)
    assert list(teacher.curriculum.needs) == functions
    if {"bins", "target", "items"} & {*space} or name == "accel":
        with pytest.raises((prl.ArgumentError, TypeError), match=r"bins|target|edits"):
            prl.Teacher(recipe(**given), NUMBERS, student=Able())
    elif "named" not in space:
        prl.Teacher(recipe(**given), NUMBERS, student=Able())


def test_it_names_all_that_works_on_spaces() -> None:
    others = {"perf_gain", "task_difficulty", "paired", "frozen_proposer", "first_order_proposer"}
    listed = {row.partition("(")[0] for row in ROWS}
    assert listed | others >= {*available("method")} - others


def test_it_explains_each_function_that_it_names() -> None:
    named = {name for _, functions, _ in ROWS.values() for name in functions}
    assert named == {*re.findall(r"^\| `(\w+)`", FUNCTIONS, re.MULTILINE)}
