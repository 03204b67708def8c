"""Peers beside ours: what jaxued is given and who is refused; the rest with the real package."""

from __future__ import annotations

import os
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from proposer_rl.tasks.view_mazes.view_levels import ViewLevel
from research.benchmarks.jaxued_peer import TRAINING, WAYS
from research.benchmarks.peer import jaxued_maze, played
from research.benchmarks.timing import threads
from research.benchmarks.view import MAX_STEPS, beside_jaxued, through_minigrid
from research.benchmarks.view_training import SMALL
from tests.tasks.view_mazes.oracles import random_levels

DRAWINGS = ["v#..\n.#G.", "..<#\nG...", "G#.^\n....", "...G\n.>#."]
JAXUED = os.environ.get("JAXUED_PYTHON")
real = pytest.mark.skipif(not JAXUED, reason="JAXUED_PYTHON names no interpreter that has jaxued")


def test_levels_are_given_as_jaxued_has_them() -> None:
    """Column and row of each mark in the drawing, as jaxued's ``Level.from_str`` reads it."""
    given = played(ViewLevel.from_text(DRAWINGS), torch.zeros(5, 4, dtype=torch.int64), 250)
    for i, drawing in enumerate(DRAWINGS):
        marks = {
            mark: (column, row)
            for row, line in enumerate(drawing.split("\n"))
            for column, mark in enumerate(line)
        }
        (agent,) = marks.keys() & set(">v<^")
        assert given["agent_dir"][i] == ">v<^".index(agent)
        assert tuple(given["agent_pos"][i]) == marks[agent]
        assert tuple(given["goal_pos"][i]) == marks["G"]
        walls = [[mark == "#" for mark in line] for line in drawing.split("\n")]
        assert given["wall_map"][i].tolist() == walls
    assert given["actions"].shape == (5, 4) and given["max_steps"] == 250


@real
def test_jaxued_plays_what_minigrid_plays() -> None:
    """Over more than two episodes' time, so that goals and the step limit both end some."""
    levels = random_levels(16)
    actions = torch.randint(3, (2 * MAX_STEPS + 50, 16), generator=torch.Generator().manual_seed(0))
    expected = through_minigrid(levels, actions)
    assert expected > 1
    with threads(1), jaxued_maze(str(JAXUED), levels, actions, MAX_STEPS) as peer:
        assert peer.about.startswith("jaxued ") and peer.about.endswith(" on 1 core(s)")
        for way in WAYS:
            seconds, reward = peer.play(way)
            assert seconds > 0 and reward == pytest.approx(expected, abs=1e-3)


@real
def test_rows_are_ratios_to_each_way_of_jaxued() -> None:
    levels = random_levels(4)
    actions = torch.randint(3, (40, 4), generator=torch.Generator().manual_seed(0))
    ours, *theirs = beside_jaxued([(levels, actions)], str(JAXUED), repeats=3).rows
    for frames, relative, way in zip(theirs[::2], theirs[1::2], WAYS, strict=True):
        times = [ours.samples[name] for name in ("TorchRL", way)]
        assert frames.value.median == pytest.approx(160 / np.median(times[1]))
        ratios = [peer / mine for mine, peer in zip(*times, strict=True)]
        assert relative.value.median == pytest.approx(np.median(ratios))


@real
def test_jaxued_s_training_learns_to_walk_ahead() -> None:
    """As a Solver does that is trained: more reward on levels whose goal is in sight."""
    levels = ViewLevel.from_text([">..G", ">.G."])
    settings = replace(SMALL.config.solver.ppo, learning_rate=3e-3, entropy_coeff=0.0)
    numbers = asdict(settings) | SMALL.config.task["network"]
    actions = torch.zeros(64, 2, dtype=torch.int64)
    with threads(1), jaxued_maze(str(JAXUED), levels, actions, 12, numbers) as peer:
        rewards = [peer.play(TRAINING)[1] for _ in range(60)]
    assert sum(rewards[-5:]) > 2 * sum(rewards[:5])
