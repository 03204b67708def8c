from __future__ import annotations

import torch
from tensordict import TensorDict

from proposer_rl.learning import first_episode_return, first_episode_success


def rollout(*episodes: str) -> TensorDict:
    """One row per environment: '.' goes on, 'G' terminates, 'T' truncates."""
    terminated = torch.tensor([[mark == "G" for mark in row] for row in episodes])[None, ..., None]
    truncated = torch.tensor([[mark == "T" for mark in row] for row in episodes])[None, ..., None]
    steps = {"terminated": terminated, "done": terminated | truncated}
    return TensorDict({"next": steps}, [1, len(episodes), len(episodes[0])])


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
