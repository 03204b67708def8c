"""ADR and terrain levels against simulations, one level after another, and a Markov chain."""

from __future__ import annotations

import random
from typing import Any

import pytest
import torch

import proposer_rl as prl
from proposer_rl.curricula import BoundsCurriculum, RowsCurriculum, Student
from proposer_rl.curricula.points import Points, nearest
from proposer_rl.streams import Streams
from tests.curricula.scripted import Scripted, reached, step

SPACE = prl.Parameters({"a": (0.0, 10.0), "b": (-1.0, 1.0)}, bins=5)
STEP, EPISODES = 0.3, 3


def skill(a: float, b: float) -> float:
    """Solved from a = 2 to 8 and below b = 0.5, half solved up to 0.8."""
    return float(2 <= a <= 8) * (1.0 if b < 0.5 else 0.5 if b < 0.8 else 0.0)


class Simulated:
    """Algorithm 1 of the paper, of one student."""

    def __init__(self, start: dict[str, float]) -> None:
        self.start = start
        self.bounds = {(axis, side): at for axis, at in start.items() for side in ("low", "high")}
        self.buffers: dict[tuple[str, str], list[float]] = {key: [] for key in self.bounds}

    def play(self, key: tuple[str, str], place: float, performance: float) -> None:
        if place != self.bounds[key]:
            return
        self.buffers[key].append(performance)
        if len(self.buffers[key]) < EPISODES:
            return
        mean, self.buffers[key] = sum(self.buffers[key]) / EPISODES, []
        out = STEP if mean >= 0.7 else -STEP if mean <= 0.3 else 0.0
        if key[1] == "high":
            self.bounds[key] = min(max(place + out, self.start[key[0]]), 1.0)
        else:
            self.bounds[key] = max(min(place - out, self.start[key[0]]), -1.0)


@pytest.mark.parametrize(
    "space", [SPACE, prl.Items(7, features=torch.rand(7, 2, generator=torch.Generator()))]
)
def test_points_become_levels_of_the_nearest_bins_on_grids_and_elsewhere(space: Any) -> None:
    draw = torch.Generator().manual_seed(0)
    points = torch.cat([2 * torch.rand(200, 2, generator=draw) - 1, torch.tensor([[0.25, -0.75]])])
    _, bins = Points(space, True).levels(points.double(), Streams(0))
    assert bins.equal(nearest(points.double(), space.coordinates.double()))


@pytest.mark.parametrize("count", [3, 16])
def test_bounds_move_as_in_a_simulation(count: int) -> None:
    """Batches come back late and in parts; of the third one some never do."""
    start = {"a": 0.1, "b": -0.9}
    curriculum = BoundsCurriculum(
        SPACE, start=start, step=STEP, lower=0.3, upper=0.7, episodes=EPISODES, rounded=False
    )
    simulated, batches, seen = Simulated(start), [], set()
    keys = [(axis, side) for axis in ("a", "b") for side in ("low", "high")]
    for update in range(480 // count):
        batch = curriculum.propose(Student(), count, Streams(1, update))
        found = curriculum.bounds.flatten().tolist()
        assert found == [simulated.bounds[key] for key in keys]
        seen |= {tuple(found)}
        for name, low, high in (("a", 0.0, 10.0), ("b", -1.0, 1.0)):
            places = 2 * (batch.levels[name] - low) / (high - low) - 1
            assert (places >= simulated.bounds[name, "low"] - 1e-12).all()
            assert (places <= simulated.bounds[name, "high"] + 1e-12).all()
        batches.append(batch)
        if len(batches) < 3:
            continue
        late = batches.pop(0)
        levels = zip(late.levels["a"], late.levels["b"], strict=True)
        told = torch.tensor([skill(float(a), float(b)) for a, b in levels])
        came = torch.arange(count)[slice(0, None) if update != 4 else slice(0, count // 2)]
        for part in (came[: count // 3], came[count // 3 :]):
            curriculum.observe(Student(), late[part], reached(told[part], told[part]))
        for place, which in enumerate(late.notes["bound"][came].tolist()):
            if which >= 0:
                simulated.play(keys[which], float(late.notes["at"][place]), float(told[place]))
    assert len(seen) > 8
    # Within two steps of where the student fails.
    assert simulated.bounds["b", "low"] == -1.0 and -0.1 <= simulated.bounds["b", "high"] <= 1.0
    assert -0.9 <= simulated.bounds["a", "low"] <= -0.1 and simulated.bounds["a", "high"] >= 0.3


def test_levels_lie_on_bounds_as_often_as_asked_and_else_uniformly_within() -> None:
    curriculum = BoundsCurriculum(SPACE, boundary=0.4, rounded=False)
    curriculum.propose(Student(), 1, Streams(0))
    curriculum.bounds = torch.tensor([[-0.5, 0.25], [0.0, 1.0]]).double()
    batch = curriculum.propose(Student(), 20_000, Streams(1))
    places = torch.stack([batch.levels["a"] / 5 - 1, batch.levels["b"]], -1)
    which = batch.notes["bound"]
    shares = (which + 1).bincount(minlength=5) / 20_000
    torch.testing.assert_close(shares, torch.tensor([0.6, *[0.1] * 4]), atol=0.012, rtol=0)
    for bound, at in enumerate([-0.5, 0.25, 0.0, 1.0]):
        rest = places[which == bound]
        assert (rest[:, bound // 2] - at).abs().max() < 1e-12 and rest.std(0).min() == 0
        assert rest.std(0).max() > 0.2 * (1 if bound < 2 else 0.75)
    inside = places[which == -1]
    for axis, (low, high) in enumerate([(-0.5, 0.25), (0.0, 1.0)]):
        quarters = ((inside[:, axis] - low) / (high - low) * 4).long().bincount(minlength=4)
        torch.testing.assert_close(
            quarters / len(inside), torch.full((4,), 0.25), atol=0.02, rtol=0
        )


def test_on_bins_it_goes_from_the_start_to_where_the_student_fails() -> None:
    for reached_last in (8, 5):
        skills = torch.ones(9)
        skills[reached_last + 1 :] = 0.0
        task = Scripted(skills, batch_size=24)
        curriculum = BoundsCurriculum(task.space, start={"place": -1.0}, step=0.25, episodes=4)
        assert (step(curriculum, task, 0) == 0).all()
        for update in range(1, 40):
            last = step(curriculum, task, update)
        told = curriculum.log()
        assert reached_last <= int(last.max()) <= min(reached_last + 1, 8) and last.min() == 0
        assert told["width"] == 2.0 if reached_last == 8 else 1.25 <= told["width"] <= 1.5
        assert sum(told["histogram"]) == 40 * 24


ROWS = 10
TERRAIN = prl.Parameters({"speed": (0.0, 2.0), "row": range(ROWS)}, bins={"speed": 3, "row": ROWS})


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
    teacher = prl.Teacher("terrain_levels", TERRAIN, seed=1)
    robots, draw = 1024, torch.Generator().manual_seed(0)
    ids, levels = teacher.ask(robots)
    assert levels["row"].max() == 5 and levels["row"].min() == 0
    seen = torch.zeros(ROWS)
    for turn in range(100):
        ending = torch.randperm(robots, generator=draw)[:512]
        chance = torch.tensor(success)[levels["row"][ending]]
        won = torch.rand(512, generator=draw) < chance
        teacher.tell(ids[ending], won, won)
        ids[ending], levels[ending] = teacher.ask(512)
        if turn >= 40:
            seen += levels["row"].bincount(minlength=ROWS)
    torch.testing.assert_close(
        seen.double() / seen.sum(), stationary(success), atol=0.01, rtol=0.05
    )
    speed = teacher.log()["drawn"]["speed"].values()
    assert max(speed) < 1.1 * min(speed)


def test_rows_move_as_of_one_robot_after_another() -> None:
    """Batches of three sizes, of which half of one never comes back."""
    curriculum = RowsCurriculum(TERRAIN, start=1, lower=0.3, upper=0.7)
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
