"""Episodes of arena environments, played by scripted policies."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from proposer_rl.tasks.batched_envs.env import BatchedEnv


def levels(**columns: list[float] | list[int] | Tensor) -> TensorDict:
    """Returns levels [B] of columns of numbers."""
    entries = {name: torch.as_tensor(column) for name, column in columns.items()}
    return TensorDict(entries, [len(next(iter(entries.values())))])


def play(env: BatchedEnv, policy: Callable[[TensorDictBase], Tensor]) -> tuple[Tensor, Tensor]:
    """Plays an episode on each level [B]; returns return and success, float and bool [B]."""
    check_env_specs(env)
    now = env.reset()
    total = torch.zeros(env.batch_size)
    over, success = now["done"].squeeze(-1), now["success"].squeeze(-1)
    for _ in range(env.max_steps):
        now = env.step(now.set("action", policy(now)))["next"]
        total += now["reward"].squeeze(-1) * ~over
        success |= now["success"].squeeze(-1) & ~over
        over |= now["done"].squeeze(-1)
    assert over.all()
    return total, success
