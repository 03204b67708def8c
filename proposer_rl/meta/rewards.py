"""Rewards of the Proposer: functions of one training step of K Solvers, each to float [K]."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning import first_episode_success
from proposer_rl.models import ActorCritic
from proposer_rl.task import NoSuccessError

LEAST_SUCCESS = 1e-3
"""Success rates far below this hardly matter in :func:`log_success`."""


class TrainingStep(NamedTuple):
    """One PPO update of K Solvers, from which the Proposer's reward is computed.

    Attributes:
        levels: that they trained on, batch [K, P].
        rollout: the transitions that they collected there before the update, [K, P, T].
        agent: the Solvers after the update.
        before, after: their performance on the validation levels, tensordicts [K, E] with
            ``return`` and, if the task has one, ``success``. While an action is repeated, both are
            from before the action, except in its last update.
    """

    levels: Any
    rollout: TensorDictBase
    agent: ActorCritic
    before: TensorDictBase
    after: TensorDictBase


# The reward of a training step for each Solver, float [K].
Reward = Callable[[TrainingStep], Tensor]


def performance_gain(step: TrainingStep) -> Tensor:
    """Returns the gain in mean return on the validation levels: R(after) - R(before).

    The paper's reward (its section on the method; docs/explanation/method.md).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> before, after = (
        ...     TensorDict({"return": torch.tensor([[x, 0.3]])}, [1, 2]) for x in (0.1, 0.5)
        ... )
        >>> performance_gain(TrainingStep(None, None, None, before, after))
        tensor([0.2000])
    """
    return mean_return(step.after) - mean_return(step.before)


def log_success_gain(step: TrainingStep) -> Tensor:
    """Returns the gain in mean log(success + 0.001) on the validation levels.

    This is the default. The return of a beginner on the target hardly moves: from one success in
    five hundred to one in a hundred is a step of 0.008. The logarithm of its success moves by 1.6,
    which shows the effect of the training.
    """
    return mean_log_success(step.after) - mean_log_success(step.before)


def task_difficulty(step: TrainingStep) -> Tensor:
    """Returns one minus the success rate on the proposed levels (the paper's ablation).

    The success rate is that of the Solver's own training episodes, the first on every level. If
    episodes go on from update to update, the first to end may have begun on a level of an earlier
    update.
    """
    return 1.0 - first_episode_success(step.rollout).float().mean(1)


def mean_return(performance: TensorDictBase) -> Tensor:
    """Returns the mean return over levels, float [K] from [K, E]."""
    return performance["return"].mean(1)


def mean_log_success(performance: TensorDictBase) -> Tensor:
    """Returns the mean of :func:`log_success` over levels, float [K] from [K, E]."""
    return log_success(performance).mean(1)


def log_success(performance: TensorDictBase) -> Tensor:
    """Returns log(success + 0.001) of every level, float [*B].

    Raises:
        NoSuccessError: if the task has no success, only a return.
    """
    if "success" not in performance.keys():
        raise NoSuccessError(
            "log_success: this task tells no success, only the return. For a Proposer take the "
            "reward proposer_rl.meta.rewards.performance_gain and observes=[return], for "
            "first-order gain measure=return"
        )
    return (performance["success"] + LEAST_SUCCESS).log()
