from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm
from torch import Tensor

from proposer_rl.tasks.mazes import Level, generate_levels
from proposer_rl.tasks.mazes.evaluation import (
    ExactEvaluator,
    RolloutEvaluator,
    expected_visits,
    optimal_return,
    policy_path,
    success_from_cells,
    worst_mean,
)
from tests.tasks.mazes.oracles import moved, play, random_levels


def random_logits(*shape: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def constant_logits(probabilities: list[float], height: int, width: int) -> Tensor:
    return torch.tensor(probabilities).log().view(4, 1, 1).expand(4, height, width)


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


def by_dense_matrix(
    level: Level, policy: Tensor, max_steps: int, step_penalty: float
) -> tuple[float, float]:
    """Return and success by repeated multiplication with the chain's whole matrix, in float64."""
    width = level.walls.shape[1]
    matrix = chain(level, policy)
    start, goal = (int(cell[0] * width + cell[1]) for cell in (level.start, level.goal))
    state, total = np.eye(len(matrix))[start], 0.0
    for _ in range(max_steps):
        before, state = state, state @ matrix
        total += state[goal] - before[goal] - step_penalty * (1 - before[goal])
    return total, state[goal]


@settings(max_examples=30)
@given(
    size=st.tuples(st.integers(1, 6), st.integers(2, 6)),
    seed=st.integers(0, 10_000),
    max_steps=st.integers(0, 40),
    greedy=st.booleans(),
    scale=st.sampled_from([0.0, 1.0, 30.0]),
)
def test_exact_values_agree_with_the_dense_chain(
    size: tuple[int, int], seed: int, max_steps: int, greedy: bool, scale: float
) -> None:
    levels = random_levels(4, *size, 0.3, seed)
    logits = random_logits(4, 4, *size, seed=seed, scale=scale)
    result = ExactEvaluator(max_steps, 0.05, greedy)(
        levels.reshape(2, 2), logits.unflatten(0, (2, 2))
    )
    assert result.batch_size == (2, 2)
    policy = logits.softmax(1)
    if greedy:
        policy = torch.zeros_like(logits).scatter(1, logits.argmax(1, keepdim=True), 1.0)
    for i, level in enumerate(levels):
        expected = by_dense_matrix(level, policy[i], max_steps, 0.05)
        found = result["return"].flatten()[i].item(), result["success"].flatten()[i].item()
        assert found == pytest.approx(expected, abs=2e-5)


def test_exact_agrees_with_episodes_of_the_environment() -> None:
    levels = generate_levels([0.2] * 12, 3, 5, 5, generator=torch.Generator().manual_seed(0))
    logits = random_logits(12, 4, 5, 5, scale=0.5)
    episodes = 4000
    exact = ExactEvaluator()(levels, logits)
    played = RolloutEvaluator(episodes=episodes)(levels, logits, torch.Generator().manual_seed(1))
    bound = norm.isf(1e-4)  # two-sided, so 1 in 200 for the 24 comparisons together
    success = exact["success"]
    assert success.min() > 0.02 and success.max() < 0.98
    error = (success * (1 - success) / episodes).sqrt()
    assert ((played["success"] - success).abs() < bound * error).all()
    # A return is a success minus at most 25 steps of 0.01, so its deviation is at most this much.
    error = error + 0.125 / episodes**0.5
    assert ((played["return"] - exact["return"]).abs() < bound * error).all()


def test_copies_play_with_the_same_numbers_in_any_company() -> None:
    levels, logits = random_levels(12, 4, 4, 0.2, 0), random_logits(3, 12, 4, 4, 4)

    def returns(copies: slice) -> Tensor:
        generator, own = torch.Generator().manual_seed(0), logits[copies]
        return RolloutEvaluator(episodes=3)(levels.expand(len(own), 12), own, generator)["return"]

    together = returns(slice(3))
    assert torch.equal(returns(slice(1, 3)), together[1:])
    assert not torch.equal(together[0], together[1])


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_greedy_policies_agree_with_a_simulator(seed: int) -> None:
    """The evaluator and the path; equal logits, of which the first counts, are common here."""
    levels = random_levels(6, 3, 4, 0.2, seed)
    logits = random_logits(6, 4, 3, 4, seed=seed).round()
    exact = ExactEvaluator(9, 0.25, greedy=True)(levels, logits)
    paths = policy_path(levels, logits, max_steps=9)
    assert (paths.shape, paths.dtype) == ((6, 10, 2), torch.int64)
    for i, level in enumerate(levels):
        cell, path, rewards = tuple(level.start.tolist()), [level.start.tolist()], []
        for _ in range(9):
            scores = logits[i, :, cell[0], cell[1]].tolist()
            one_step = Level(level.walls, torch.tensor(cell), level.goal, batch_size=[])
            cell, reward, terminated, _ = next(play(one_step, [scores.index(max(scores))], 9, 0.25))
            path.append(list(cell))
            rewards.append(reward)
            if terminated:
                break
        success = float(path[-1] == level.goal.tolist())
        assert exact[i]["success"].item() == pytest.approx(success)
        assert exact[i]["return"].item() == pytest.approx(sum(rewards))
        assert paths[i].tolist() == path + path[-1:] * (10 - len(path))


def test_logits_of_an_expanded_batch_are_left_as_they_were() -> None:
    levels = random_levels(3, 4, 4, 0.2, 0).expand(5, 3)
    logits = random_logits(5, 3, 4, 4, 4).requires_grad_()
    before = logits.detach().clone()
    with torch.no_grad():
        expected = ExactEvaluator()(levels, logits)
    found = ExactEvaluator()(levels, logits)  # with gradients, each step has memory of its own
    assert found["return"].requires_grad and not expected["return"].requires_grad
    assert torch.equal(found["return"].detach(), expected["return"])
    alone = ExactEvaluator()(levels[2, 1], before[2, 1])
    assert alone.batch_size == () and alone["return"].item() == pytest.approx(
        expected["return"][2, 1].item()
    )
    assert torch.equal(logits, before)


def best_play(level: Level, max_steps: int, step_penalty: float) -> float:
    """The largest return by trying all sequences of actions, without those that repeat a state."""
    goal, best = tuple(level.goal.tolist()), -step_penalty * max_steps
    here = {tuple(level.start.tolist())}
    for step in range(1, max_steps + 1):
        here = {moved(level, cell, action) for cell in here for action in range(4)}
        if goal in here:
            best = max(best, 1 - step_penalty * step)
            here.remove(goal)  # the episode ends there
    return best


@settings(max_examples=30)
@given(
    size=st.tuples(st.integers(1, 4), st.integers(2, 4)),
    fraction=st.sampled_from([0.0, 0.3, 0.6]),
    max_steps=st.integers(1, 12),
    step_penalty=st.sampled_from([0.0, 0.01, 0.5, 3.0]),
    seed=st.integers(0, 10_000),
)
def test_the_optimum_is_what_the_best_sequence_of_actions_gets(
    size: tuple[int, int], fraction: float, max_steps: int, step_penalty: float, seed: int
) -> None:
    levels = random_levels(4, *size, fraction, seed)
    expected = [best_play(level, max_steps, step_penalty) for level in levels]
    found = optimal_return(levels.reshape(2, 2), max_steps, step_penalty)
    assert (found.shape, found.dtype) == ((2, 2), torch.float32)
    assert found.flatten().tolist() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("moves", "expected"), [(25, 1 - 25 * 0.01), (26, -25 * 0.01)])
def test_by_default_an_episode_has_the_papers_25_moves(moves: int, expected: float) -> None:
    corridor = Level.from_text(f"S{'.' * (moves - 1)}G")
    ahead = constant_logits([1e-30, 1e-30, 1e-30, 1.0], 1, moves + 1)
    assert ExactEvaluator()(corridor, ahead)["return"].item() == pytest.approx(expected, abs=1e-5)
    assert optimal_return(corridor).item() == pytest.approx(expected, abs=1e-5)


@given(
    values=st.lists(st.floats(0, 1, width=32), min_size=1, max_size=12),
    tenths=st.integers(1, 10),
)
def test_the_worst_mean_counts_the_last_value_in_part(values: list[float], tenths: int) -> None:
    # Ten of every value make the part a whole number.
    tenfold = sorted(values * 10)[: len(values) * tenths]
    expected = sum(tenfold) / len(tenfold)
    found = worst_mean(torch.tensor([values, values[::-1]]), tenths / 10)
    assert found.tolist() == pytest.approx([expected] * 2, abs=1e-5)


def test_gradients_agree_with_finite_differences() -> None:
    levels = random_levels(3, 3, 4, 0.2, 1)
    logits = random_logits(3, 4, 3, 4, seed=1).double().requires_grad_()
    evaluator = ExactEvaluator(max_steps=7, step_penalty=0.1)

    def evaluate(logits: Tensor) -> tuple[Tensor, Tensor]:
        result = evaluator(levels, logits)
        return result["return"], result["success"]

    assert torch.autograd.gradcheck(evaluate, logits, eps=1e-6, atol=1e-8, rtol=1e-6)


def test_double_precision_is_kept() -> None:
    levels, logits = random_levels(2, 3, 3, 0.2, 3), random_logits(2, 4, 3, 3).double()
    result = ExactEvaluator(max_steps=8, step_penalty=0.05)(levels, logits)
    for i, level in enumerate(levels):
        expected = by_dense_matrix(level, logits[i].softmax(0), 8, 0.05)
        assert (result["return"][i].item(), result["success"][i].item()) == pytest.approx(
            expected, abs=1e-14
        )
    for greedy in (True, False):
        half = ExactEvaluator(greedy=greedy)(levels, logits.half())
        assert {entry.dtype for entry in half.values()} == {torch.float32}


STEPS = 9


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
