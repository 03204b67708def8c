"""Scores of levels without any episode, each by what it asks of the student.

Those of an :class:`~proposer_rl.task.EpisodeLaw` are expectations of what episodes tell: over ever
more of them the mean of the score from episodes is this number.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from proposer_rl.curricula.student import Student
from proposer_rl.task import EpisodeLaw, Levels, NoSuccessError


def return_variance(student: Student, levels: Levels, episodes: int) -> Tensor:
    """Variance of an episode's return, float64 [K, n]."""
    law = student.episode_law(levels)
    mean = (law.probability * law.outcome).sum(-1, keepdim=True)
    return (law.probability * (law.outcome - mean).square()).sum(-1)


def max_mc(student: Student, levels: Levels, episodes: int) -> Tensor:
    """Expected highest return of so many episodes, minus the mean value of an episode's states."""
    law = student.episode_law(levels)
    return expected_best(law, episodes) - (law.weight * law.value).sum(-1)


def one_step_td_error(student: Student, levels: Levels, episodes: int) -> Tensor:
    """Expected mean of abs(r + gamma V' - V) over the steps of an episode, float64 [K, n]."""
    law = student.episode_law(levels)
    delta = law.reward + student.gamma * law.next_value - law.value
    return (law.weight * delta.abs()).sum(-1)


def expected_best(law: EpisodeLaw, episodes: int) -> Tensor:
    """Expectation of the highest of n independent returns, float64 [*B].

    With F their distribution function it is the sum over the outcomes x of x (F(x)^n - F(x-)^n).
    """
    order = law.outcome.argsort(-1)
    below = law.probability.gather(-1, order).cumsum(-1).clamp(0, 1) ** episodes
    chance = below.diff(dim=-1, prepend=torch.zeros_like(below[..., :1]))
    return (law.outcome.gather(-1, order) * chance).sum(-1)


def learnability(student: Student, levels: Levels, episodes: int) -> Tensor:
    """P (1 - p) of the probability p of success.

    Raises:
        NoSuccessError: if there is no success.
    """
    performance = student.exact_performance(levels)
    if "success" not in performance.keys():
        raise NoSuccessError(
            "learnability: this task tells no success, only the return; of the scores regret and "
            "gradient norms take that"
        )
    success = performance["success"]
    return success * (1 - success)


def regret(student: Student, levels: Levels, episodes: int) -> Tensor:
    """The largest return that any policy reaches, minus the student's."""
    return student.optimal_return(levels) - student.exact_performance(levels)["return"]


def spread(student: Student, levels: Levels, episodes: int) -> Tensor:
    """Variance of the return as a model tells it; see :func:`in_coins`.

    Raises:
        NoSuccessError: if no model answers.
    """
    performance = student.exact_performance(levels)
    if "spread" not in performance.keys():
        raise NoSuccessError("spread: only a model tells it, as with +source=model")
    return performance["spread"]


def in_coins(variance: Tensor) -> Tensor:
    """Variances [K, n] in units in which the largest is a coin's, 1/4."""
    return variance / (4 * variance.amax(-1, keepdim=True)).clamp(min=torch.finfo().tiny)


EXACT: dict[str, tuple[tuple[str, ...], Callable[[Student, Levels, int], Tensor]]] = {
    "learnability": (("exact_performance",), learnability),
    "regret": (("optimal_return", "exact_performance"), regret),
    "spread": (("exact_performance",), spread),
    "gradient_norm": (
        ("gradient_norms",),
        lambda student, levels, _: student.gradient_norms(levels),
    ),
    "return_variance": (("episode_law",), return_variance),
    "max_mc": (("episode_law",), max_mc),
    "one_step_td_error": (("episode_law",), one_step_td_error),
}
"""Of each score what it needs of a student, and what it is: float [K, n].

That is a function of the student, levels [K, n], and the episodes of which ``max_mc`` takes the
expected highest return.
"""
