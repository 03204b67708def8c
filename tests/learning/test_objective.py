from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from proposer_rl.learning import LeaveOneOutBaseline


def episodes(rewards: torch.Tensor) -> TensorDict:
    """Episodes [K, T] that end with the last step."""
    done = torch.zeros(*rewards.shape, 1, dtype=torch.bool)
    done[:, -1] = True
    following = TensorDict({"reward": rewards.unsqueeze(-1), "done": done}, rewards.shape)
    return TensorDict({"next": following}, rewards.shape)


@pytest.mark.parametrize("gamma", [1.0, 0.9, 1e-6, 1e-8, 5e-324, 0.0])
def test_the_return_to_come_minus_the_mean_of_the_others(gamma: float) -> None:
    rewards = torch.randn(4, 3, generator=torch.Generator().manual_seed(0))
    out = LeaveOneOutBaseline(gamma)(episodes(rewards))
    for k in range(4):
        for t in range(3):
            to_come = [sum(gamma**s * r[t + s] for s in range(3 - t)) for r in rewards]
            others = sum(to_come[j] for j in range(4) if j != k) / 3
            torch.testing.assert_close(out["advantage"][k, t, 0], to_come[k] - others)
            torch.testing.assert_close(out["value_target"][k, t, 0], to_come[k])


def test_what_all_copies_share_is_no_ones_merit() -> None:
    advantage = LeaveOneOutBaseline(1.0)(episodes(torch.arange(5.0).expand(3, 5)))["advantage"]
    torch.testing.assert_close(advantage, torch.zeros(3, 5, 1))
