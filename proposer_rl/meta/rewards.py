"""What the Proposer is paid for: functions of one training step of K Solvers, each to [K]."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning.rollout import first_episode_success
from proposer_rl.models import ActorCritic


class TrainingStep(NamedTuple):
    """One PPO update of K Solvers, as a reward sees it.

    Attributes:
        levels: what they trained on, batch [K, P].
        rollout: the transitions that they collected there before the update, [K, P, T].
        solver: the Solvers after the update.
        return_before, return_after: mean return on the validation levels, float [K].
    """

    levels: Any
    rollout: TensorDictBase
    solver: ActorCritic
    return_before: Tensor
    return_after: Tensor


# The reward of a training step for each Solver, float [K].
Reward = Callable[[TrainingStep], Tensor]


def performance_gain(step: TrainingStep) -> Tensor:
    """How much the Solver's return on the validation levels went up (the paper's reward).

    Example:
        >>> import torch
        >>> before, after = torch.tensor([0.1, 0.4]), torch.tensor([0.3, 0.2])
        >>> performance_gain(TrainingStep(None, None, None, before, after))
        tensor([ 0.2000, -0.2000])
    """
    return step.return_after - step.return_before


def task_difficulty(step: TrainingStep) -> Tensor:
    """One minus the success rate on the levels just proposed (the paper's ablation).

    The rate is that of the Solver's own training episodes, the first on every level.
    """
    return 1.0 - first_episode_success(step.rollout).float().mean(1)
