"""Terrain levels against the Markov chain that they are, and one robot after another."""

from __future__ import annotations

import random

import pytest
import torch

import proposer_rl as prl
from proposer_rl.curricula import RowsCurriculum, Student
from proposer_rl.streams import Streams
from tests.curricula.scripted import reached

ROWS = 10
SPACE = prl.Parameters({"speed": (0.0, 2.0), "row": range(ROWS)}, bins={"speed": 3, "row": ROWS})


def stationary(success: list[float]) -> torch.Tensor:
    """Shares of the rows in the long run, by linear algebra on the chain of one robot."""
    rows = len(success)
    chain = torch.zeros(rows, rows, dtype=torch.float64)
    for row, p in enumerate(success):
        chain[row, max(row - 1, 0)] += 1 - p
        if row + 1 < rows:
            chain[row, row + 1] += p
        else:
            chain[row] += p / rows
    balance = torch.cat([chain.T - torch.eye(rows).double(), torch.ones(1, rows).double()])
    total = torch.zeros(rows + 1).double()
    total[-1] = 1
    return torch.linalg.lstsq(balance, total.unsqueeze(1)).solution.squeeze(1)


@pytest.mark.parametrize("success", [[1.0] * ROWS, [0.95 - 0.06 * row for row in range(ROWS)]])
def test_levels_are_in_rows_as_often_as_the_chain_says(success: list[float]) -> None:
    """A teacher's, thousands out at once, of which half end at each step."""
    teacher = prl.Teacher("terrain_levels", SPACE, seed=1)
    robots, draw = 1024, torch.Generator().manual_seed(0)
    ids, levels = teacher.ask(robots)
    assert levels["row"].max() == 5 and levels["row"].min() == 0
    seen = torch.zeros(ROWS)
    for step in range(100):
        ending = torch.randperm(robots, generator=draw)[:512]
        chance = torch.tensor(success)[levels["row"][ending]]
        won = torch.rand(512, generator=draw) < chance
        teacher.tell(ids[ending], won, won)
        ids[ending], levels[ending] = teacher.ask(512)
        if step >= 40:
            seen += levels["row"].bincount(minlength=ROWS)
    torch.testing.assert_close(
        seen.double() / seen.sum(), stationary(success), atol=0.01, rtol=0.05
    )
    speed = teacher.log()["drawn"]["speed"].values()
    assert max(speed) < 1.1 * min(speed)


def test_rows_move_as_of_one_robot_after_another() -> None:
    """Batches of three sizes, of which half of one never comes back."""
    curriculum = RowsCurriculum(SPACE, start=1, lower=0.3, upper=0.7)
    luck, queue = random.Random(0), []
    for update in range(60):
        batch = curriculum.propose(Student(), (6, 4, 9)[update % 3], Streams(0, update))
        rows = batch.levels["row"].tolist()
        for row in rows:
            expected = queue.pop(0) if queue else "first"
            assert row == expected or (expected == "first" and row <= 1) or expected == "any"
        told = torch.tensor([luck.choice([0.1, 0.5, 0.8, 1.0]) for _ in rows])
        came = slice(0, 3 if update == 7 else None)
        curriculum.observe(Student(), batch[came], reached(told[came], told[came]))
        for row, one in zip(rows[came], told[came].tolist(), strict=True):
            move = 1 if one >= 0.7 else -1 if one < 0.3 else 0
            queue.append("any" if row + move == ROWS else max(row + move, 0))
    assert max(rows) == ROWS - 1
    log = curriculum.log()
    assert log["mean_row"] == pytest.approx(sum(rows) / len(rows))
    assert sum(map(sum, log["histogram"])) == 20 * 19 - 1


def test_rows_are_the_first_axis_unless_one_is_called_so() -> None:
    curriculum = RowsCurriculum(prl.Parameters({"a": (0.0, 1.0), "b": (0.0, 1.0)}, bins=4), start=0)
    levels = curriculum.propose(Student(), 64, Streams(0)).levels
    assert levels["a"].max() < 0.25 and levels["b"].max() > 0.75
