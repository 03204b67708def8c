from __future__ import annotations

import torch
from tensordict import TensorDict

from proposer_rl.meta.rewards import (
    TrainingStep,
    performance_gain,
    task_difficulty,
)


def rollout(*episodes: str) -> TensorDict:
    """One row per environment: '.' goes on, 'G' terminates, 'T' truncates."""
    terminated = torch.tensor([[mark == "G" for mark in row] for row in episodes])[None, ..., None]
    truncated = torch.tensor([[mark == "T" for mark in row] for row in episodes])[None, ..., None]
    steps = {"terminated": terminated, "done": terminated | truncated}
    return TensorDict({"next": steps}, [1, len(episodes), len(episodes[0])])


def step(**fields) -> TrainingStep:
    blank = {"levels": None, "rollout": rollout("G."), "solver": None}
    returns = {"return_before": torch.tensor([0.1]), "return_after": torch.tensor([0.4])}
    return TrainingStep(**{**blank, **returns, **fields})


def test_gain_is_the_increase_in_return() -> None:
    torch.testing.assert_close(performance_gain(step()), torch.tensor([0.3]))


def test_difficulty_is_the_failure_rate() -> None:
    batch = rollout("..G.", "..TG", "....", "G.T.")
    torch.testing.assert_close(task_difficulty(step(rollout=batch)), torch.tensor([0.5]))
