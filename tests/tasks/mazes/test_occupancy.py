"""What comes of a policy, by powers of its transition matrix."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from proposer_rl.tasks.mazes import Level
from proposer_rl.tasks.mazes.evaluation import (
    ExactEvaluator,
    expected_visits,
    success_from_cells,
)
from tests.tasks.mazes.oracles import moved, random_levels

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
