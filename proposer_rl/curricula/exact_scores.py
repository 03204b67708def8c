"""Scores that a task tells without any episode, each by what it asks of the task.

Those of an :class:`~proposer_rl.task.EpisodeLaw` are expectations of what episodes tell: over ever
more of them the mean of the score from episodes is this number.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import cast

import torch
from torch import Tensor

from proposer_rl.learning import PPO
from proposer_rl.meta.gradient_norms import squared_gradients
from proposer_rl.task import (
    DifferentiableTask,
    EnumerableTask,
    EpisodeLaw,
    ExactTask,
    Levels,
    NoSuccessError,
    OptimalTask,
    Task,
)

Asks = Callable[[PPO, Levels, torch.Generator], Tensor]
"""Of a learner of K Solvers, levels [K, n] and what a task draws from: float [K, n]."""


def return_variance(law: EpisodeLaw, gamma: float, episodes: int) -> Tensor:
    """Variance of an episode's return, float64 [*B]."""
    mean = (law.probability * law.outcome).sum(-1, keepdim=True)
    return (law.probability * (law.outcome - mean).square()).sum(-1)


def max_mc(law: EpisodeLaw, gamma: float, episodes: int) -> Tensor:
    """Expected highest return of so many episodes, minus the mean value of an episode's states."""
    return expected_best(law, episodes) - (law.weight * law.value).sum(-1)


def one_step_td_error(law: EpisodeLaw, gamma: float, episodes: int) -> Tensor:
    """Expected mean of abs(r + gamma V' - V) over the steps of an episode, float64 [*B]."""
    delta = law.reward + gamma * law.next_value - law.value
    return (law.weight * delta.abs()).sum(-1)


def expected_best(law: EpisodeLaw, episodes: int) -> Tensor:
    """Expectation of the highest of n independent returns, float64 [*B].

    With F their distribution function it is the sum over the outcomes x of x (F(x)^n - F(x-)^n).
    """
    order = law.outcome.argsort(-1)
    below = law.probability.gather(-1, order).cumsum(-1).clamp(0, 1) ** episodes
    chance = below.diff(dim=-1, prepend=torch.zeros_like(below[..., :1]))
    return (law.outcome.gather(-1, order) * chance).sum(-1)


OF_THE_LAW = {score.__name__: score for score in (return_variance, max_mc, one_step_td_error)}
EXACT = ("learnability", "regret", "gradient_norm", *OF_THE_LAW)


def exact_score(task: Task, name: str, episodes: int) -> Asks:
    """Makes what asks a task for one of the scores in :data:`EXACT`.

    Args:
        task: whose levels are scored.
        name: of the score.
        episodes: of which ``max_mc`` takes the expected highest return.

    Raises:
        TypeError: if the task lacks what the score needs.
        ValueError: if it tells by playing what the score needs exactly.
    """
    kind = type(task).__name__
    if name in OF_THE_LAW:
        if not isinstance(task, EnumerableTask):
            raise TypeError(
                f"score={name} from source=exact needs the law of an episode: {kind} must define "
                "episode_law(agent, levels); source=episodes needs nothing"
            )
        return partial(_by_law, task, OF_THE_LAW[name], episodes)
    if name == "gradient_norm":
        if not isinstance(task, DifferentiableTask):
            raise TypeError(
                f"score=gradient_norm needs gradients: {kind} must define "
                "differentiable_performance(agent, levels)"
            )
        norms = squared_gradients(cast(ExactTask, task))
        return lambda learner, levels, _: norms(learner, levels)
    if name == "regret" and not isinstance(task, OptimalTask):
        raise TypeError(
            f"{kind} does not know the largest return (optimal_return), which "
            "score=regret from source=exact needs; source=episodes takes the best that was seen"
        )
    if not task.exact_performance:
        raise ValueError(
            f"source=exact: {kind} tells performance by playing, which is not exact; give "
            "source=episodes, as +score=sampled and +filter=learnability_sampled do"
        )
    return partial(_regret if name == "regret" else _learnability, task)


def _by_law(
    task: EnumerableTask,
    score: Callable[[EpisodeLaw, float, int], Tensor],
    episodes: int,
    learner: PPO,
    levels: Levels,
    generator: torch.Generator,
) -> Tensor:
    return score(task.episode_law(learner.agent, levels), learner.settings.gamma, episodes)


def _learnability(task: Task, learner: PPO, levels: Levels, generator: torch.Generator) -> Tensor:
    performance = task.performance(learner.agent, levels, generator)
    if "success" not in performance.keys():
        raise NoSuccessError(
            f"learnability: {type(task).__name__} tells no success, only the return; of the scores "
            "regret and gradient norms take that"
        )
    success = performance["success"]
    return success * (1 - success)


def _regret(task: Task, learner: PPO, levels: Levels, generator: torch.Generator) -> Tensor:
    reached = task.performance(learner.agent, levels, generator)["return"]
    return cast(OptimalTask, task).optimal_return(levels) - reached
