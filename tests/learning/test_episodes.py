"""First episodes of rollouts, and rewards made of them, against numbers worked out by hand."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor

from proposer_rl.learning import first_episode_return, first_episode_success
from proposer_rl.meta import rewards


def step(before: dict[str, list[float]], after: dict[str, list[float]]) -> rewards.TrainingStep:
    """What one Solver reaches on its levels before and after an update."""
    reached = ({n: torch.tensor([entry]) for n, entry in told.items()} for told in (before, after))
    performances = (TensorDict(told, next(iter(told.values())).shape) for told in reached)
    return rewards.TrainingStep(None, None, None, *performances)  # type: ignore[arg-type]


def test_gains_are_the_increase_of_a_mean() -> None:
    """Of the return, or of the logarithm of the chance of success, and 0.001."""
    given = step({"return": [0.1, 0.3]}, {"return": [0.5, 0.3]})
    torch.testing.assert_close(rewards.performance_gain(given), torch.tensor([0.2]))
    given = step({"success": [0.0, 0.009]}, {"success": [0.0, 0.999]})
    torch.testing.assert_close(rewards.log_success_gain(given), torch.tensor([math.log(100) / 2]))


def rollout(*episodes: str) -> TensorDict:
    """One row per environment: '.' goes on, 'G' terminates, 'T' truncates."""

    def flag(mark: str) -> Tensor:
        return torch.tensor([[here == mark for here in row] for row in episodes])[None, ..., None]

    steps = {"terminated": flag("G"), "done": flag("G") | flag("T")}
    return TensorDict({"next": steps}, [1, len(episodes), len(episodes[0])])


def test_difficulty_is_the_failure_rate() -> None:
    batch = rollout("..G.", "..TG", "....", "G.T.")
    given = rewards.TrainingStep(None, batch, None, None, None)  # type: ignore[arg-type]
    torch.testing.assert_close(rewards.task_difficulty(given), torch.tensor([0.5]))


def test_only_the_first_episode_counts() -> None:
    solved = first_episode_success(rollout("..G.", "..TG", "....", "G.T.", "T..G", "...G"))
    assert solved.tolist() == [[True, False, False, True, False, True]]


def test_a_return_is_that_of_the_first_episode() -> None:
    rows = ["..G.", "T.G.", "....", "G..T"]
    rewards = torch.randn(1, 4, 4, generator=torch.Generator().manual_seed(0))
    played = rollout(*rows)
    played["next", "reward"] = rewards.unsqueeze(-1)
    expected = [
        sum(rewards[0, i, : next((t + 1 for t in range(4) if row[t] != "."), 4)].tolist())
        for i, row in enumerate(rows)
    ]
    torch.testing.assert_close(first_episode_return(played), torch.tensor([expected]))
