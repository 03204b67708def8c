"""What comes of a policy: by powers of its transition matrix, by playing all that can be played."""

from __future__ import annotations

from collections import Counter
from itertools import product

import numpy as np
import pytest
import torch

from proposer_rl.tasks.mazes import Level
from proposer_rl.tasks.mazes.evaluation import (
    ExactEvaluator,
    episode_law,
    expected_visits,
    success_from_cells,
)
from tests.tasks.mazes.oracles import moved, play, random_levels

STEPS = 9


def chain(level: Level, policy: torch.Tensor) -> np.ndarray:
    """Probability of moving from cell to cell, [H*W, H*W]; the goal absorbs."""
    height, width = level.walls.shape
    matrix = np.zeros((height * width, height * width))
    for row, column in np.ndindex(height, width):
        for action in range(4):
            there = moved(level, (row, column), action)
            there = (row, column) if level.goal.tolist() == [row, column] else there
            chance = float(policy[action, row, column])
            matrix[row * width + column, there[0] * width + there[1]] += chance
    return matrix


@pytest.mark.parametrize("seed", range(4))
def test_they_are_those_of_the_markov_chain(seed: int) -> None:
    level = random_levels(1, 4, 5, 0.3, seed)[0]
    generator = torch.Generator().manual_seed(seed)
    policy = torch.randn(4, 4, 5, generator=generator).softmax(0)
    matrix = chain(level, policy)
    start, goal = ((cell[0] * 5 + cell[1]).item() for cell in (level.start, level.goal))
    success = np.linalg.matrix_power(matrix, STEPS)[:, goal].reshape(4, 5)
    free = ~level.walls.numpy()
    found = success_from_cells(level, policy, STEPS).numpy()
    np.testing.assert_allclose(found[free], success[free], atol=1e-5)
    visits = sum(np.linalg.matrix_power(matrix, step)[start] for step in range(STEPS))
    visits[goal] = 0  # no step begins there
    found = expected_visits(level, policy, STEPS).numpy()
    np.testing.assert_allclose(found.ravel(), visits, atol=1e-5)


def test_the_evaluator_tells_the_same_of_the_start() -> None:
    for level in random_levels(5, 5, 5, 0.3, 1):
        logits = torch.randn(4, 5, 5)
        result = ExactEvaluator(STEPS, 0.5)(level, logits)
        success = success_from_cells(level, logits.softmax(0), STEPS)[tuple(level.start.tolist())]
        steps = expected_visits(level, logits.softmax(0), STEPS).sum()
        torch.testing.assert_close(success, result["success"])
        torch.testing.assert_close(success - 0.5 * steps, result["return"])


LIMIT, PENALTY = 4, 0.3


@pytest.mark.parametrize("seed", range(3))
def test_the_law_of_an_episode_is_that_of_all_its_actions(seed: int) -> None:
    """Every sequence of actions is played, and counts with its probability."""
    levels = random_levels(2, 2, 3, 0.2, seed)
    generator = torch.Generator().manual_seed(seed)
    policy = torch.randn(2, 4, 2, 3, generator=generator, dtype=torch.float64).softmax(-3)
    values = torch.randn(2, 2, 3, generator=generator, dtype=torch.float64)
    found = episode_law(levels, policy, values, LIMIT, PENALTY)
    for i, level in enumerate(levels):
        returns: Counter[float] = Counter()
        weight, reward, value, after = np.zeros((4, 4, 2, 3))
        for actions in product(range(4), repeat=LIMIT):
            cell, chance, total, steps = tuple(level.start.tolist()), 1.0, 0.0, []
            for action, step in zip(
                actions, play(level, list(actions), LIMIT, PENALTY), strict=True
            ):
                there, paid, terminated, truncated = step
                place = (action, *cell)
                chance *= float(policy[i, action, cell[0], cell[1]])
                steps.append(place)
                total += paid
                reward[place], value[place] = paid, values[i, cell[0], cell[1]]
                after[place] = 0 if terminated else values[i, there[0], there[1]]
                cell = there
                if terminated or truncated:
                    break
            chance *= 0.25 ** (LIMIT - len(steps))  # of the actions that come too late
            returns[round(total, 6)] += chance
            for place in steps:
                weight[place] += chance / len(steps)
        told: Counter[float] = Counter()
        for outcome, probability in zip(found.outcome[i], found.probability[i], strict=True):
            told[round(float(outcome), 6)] += float(probability)
        assert told == pytest.approx({outcome: returns[outcome] for outcome in told})
        assert sum(returns.values()) == pytest.approx(1)
        np.testing.assert_allclose(found.weight[i], weight.ravel(), atol=1e-12)
        seen = weight.ravel() > 0
        for name, expected in (("reward", reward), ("value", value), ("next_value", after)):
            entry = getattr(found, name)[i].numpy()
            np.testing.assert_allclose(entry[seen], expected.ravel()[seen], atol=1e-9)
