from __future__ import annotations

import torch
from tensordict import TensorDict

from proposer_rl.learning.rollout import first_episode_success


def rollout(*episodes: str) -> TensorDict:
    """One row per environment: '.' goes on, 'G' terminates, 'T' truncates."""
    terminated = torch.tensor([[mark == "G" for mark in row] for row in episodes])[None, ..., None]
    truncated = torch.tensor([[mark == "T" for mark in row] for row in episodes])[None, ..., None]
    steps = {"terminated": terminated, "done": terminated | truncated}
    return TensorDict({"next": steps}, [1, len(episodes), len(episodes[0])])


def test_only_the_first_episode_counts() -> None:
    solved = first_episode_success(rollout("..G.", "..TG", "....", "G.T.", "T..G", "...G"))
    assert solved.tolist() == [[True, False, False, True, False, True]]
