"""Drawings of mazes, and what is told of a Solver there, against its single parts."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from proposer_rl.models import ActorCritic, cell_maps
from proposer_rl.streams import Streams
from proposer_rl.task import PlayableTask
from proposer_rl.tasks.mazes import Level, MazeEnv, planes
from proposer_rl.tasks.mazes.drawings import SETS, read_levels
from proposer_rl.tasks.mazes.task import MazeSettings, MazeTask, shortest_path
from tests.tasks.mazes.oracles import moved, path_length, random_levels
from tests.tiny import mountain_cars, tiny_task

DRAWN = ["S.#..", "..#..", ".....", "#.#.#", "....G"]


def shaken(agent: ActorCritic) -> ActorCritic:
    """The agent with other weights in every copy, and policies that are not even."""
    for number, parameter in enumerate(agent.parameters()):
        generator = torch.Generator().manual_seed(number)
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=generator)
    return agent


def solvers(task: MazeTask) -> ActorCritic:
    return shaken(task.learner([Streams(0), Streams(1)]).agent)


def test_only_a_task_with_drawings_is_playable() -> None:
    assert isinstance(tiny_task(), PlayableTask)
    assert not isinstance(mountain_cars(), PlayableTask)


@pytest.mark.parametrize("seed", range(20))
def test_a_shortest_path_is_one(seed: int) -> None:
    level = random_levels(1, 6, 7, 0.35, seed)[0]
    path = shortest_path(level)
    assert (-1 if path is None else len(path) - 1) == path_length(level)
    for here, there in zip(path or [], (path or [])[1:], strict=False):
        assert tuple(there) in {moved(level, tuple(here), action) for action in range(4)}
        assert here != there
    if path:
        assert path[0] == level.start.tolist() and path[-1] == level.goal.tolist()


@pytest.mark.parametrize("observe_agent", [False, True])
@pytest.mark.parametrize("solver", [0, 1])
def test_what_is_told_is_what_its_parts_tell(solver: int, observe_agent: bool) -> None:
    rules = MazeSettings(height=5, width=5, max_steps=8, observe_agent=observe_agent)
    task = tiny_task(maze=rules)
    agent, level = solvers(task), task.board.read(DRAWN)
    told = json.loads(json.dumps(task.board.examine(agent, solver, level, None)))
    assert told["max_steps"] == 16  # two for each of the eight moves
    score = task.results_of(agent, {"drawn": level}, lambda _: 16)[solver]
    for name in ("success", "return"):
        assert told["results"][name] == pytest.approx(score.results[name], abs=1e-5)
    assert 0.005 < told["results"]["success"] < 0.995
    copies = planes(level.expand(2, 1))
    logits, values = (each[solver, 0].detach() for each in cell_maps(agent, copies))
    chances = logits.softmax(0)
    maps = told["maps"]
    for row, line in enumerate(DRAWN):
        for column, mark in enumerate(line):
            known = told["policy"][row][column]
            assert (known is None) == (mark in "#G")
            assert (maps["critic's value"][row][column] is None) == (mark in "#G")
            assert (maps["expected visits"][row][column] is None) == (mark == "#")
            if known is not None:
                assert known == pytest.approx(chances[:, row, column].tolist(), abs=1e-4)
                value = values[0, row, column].item()
                assert maps["critic's value"][row][column] == pytest.approx(value, abs=1e-4)
    success = maps["success from here"]
    assert success[4][4] == 1
    assert success[0][0] == pytest.approx(told["results"]["success"], abs=1e-4)
    visits = sum(value or 0 for line in maps["expected visits"] for value in line)
    assert told["results"]["steps"] == pytest.approx(visits, abs=1e-2)


@pytest.mark.parametrize("solver", [0, 1])
def test_the_path_is_the_greedy_policys(solver: int) -> None:
    task, outcomes = tiny_task(), set()
    agent = solvers(task)
    for level in random_levels(30, 5, 5, 0.1, 3):
        told = task.board.examine(agent, solver, level, 10)
        path, goal = told["paths"]["solver"], level.goal.tolist()
        cell: Any = tuple(level.start.tolist())
        walked = [list(cell)]
        while walked[-1] != goal and walked[-1] not in walked[:-1] and len(walked) <= 10:
            row, column = cell
            chances = told["policy"][row][column]
            cell = moved(level, cell, chances.index(max(chances)))
            walked.append(list(cell))
        assert path == walked and told["goal"] == goal
        outcomes.add(path[-1] == goal)
        scored = task.results_of(agent, {"level": level}, lambda _: 10)[solver]
        assert scored.results["greedy_success"] == (path[-1] == goal)
    assert outcomes == {True, False}


def test_the_moves_that_are_told_are_the_environments() -> None:
    task = tiny_task()
    level = task.board.read(DRAWN)
    told = task.board.examine(solvers(task), 0, level, 5)
    env = MazeEnv(level)
    for cell in (~level.walls).nonzero().tolist():
        for action in range(len(task.board.actions)):
            state = env.reset()
            state.set("agent", torch.tensor(cell)).set("action", torch.tensor(action))
            row, column = env.step(state)["next", "agent"].tolist()
            assert told["next"][action][cell[0] * 5 + cell[1]] == row * 5 + column


def test_a_goal_that_cannot_be_reached_is_told() -> None:
    task = tiny_task()
    level = task.board.read(["S.#..", "..#..", "..#..", "..#..", "..#.G"])
    told = task.board.examine(solvers(task), 0, level, None)
    assert told["paths"]["shortest"] is None and told["max_steps"] == 8
    assert told["results"]["success"] == 0 and told["results"]["steps"] == pytest.approx(8)


def test_drawings_that_solvers_cannot_see_are_refused() -> None:
    with pytest.raises(ValueError, match="level 'drawn': 1x5 cells are too few"):
        tiny_task().board.read(["S...G"])


def test_drawings_go_round(tmp_path: Path) -> None:
    task = tiny_task()
    board = task.board
    for name in board.sets:
        assert [*board.level_set(name)] == [*read_levels(SETS[name])]
    level = board.read(DRAWN)
    assert board.draw(level) == DRAWN
    (tmp_path / "mine.txt").write_text(board.write_file("mine", level))
    (read,) = read_levels(tmp_path / "mine.txt").values()
    assert read.to_text() == level.to_text()
    again = board.read_file(board.write_file("mine", level))
    assert [(name, board.draw(one)) for name, one in again.items()] == [("mine", DRAWN)]
    learner = task.learner([Streams(0)])
    levels: Level = task.target.sample(4, Streams(0).generator())
    learner.env.set_levels(levels.unsqueeze(0))
    (rollout,) = learner.collect()
    for record, one in zip(task.record(levels, rollout), levels, strict=True):
        assert board.drawing(record) == board.draw(one)
