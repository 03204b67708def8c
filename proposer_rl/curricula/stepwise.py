"""Scores of levels that are read off every single step of a rollout.

With the critic V, discount gamma and trace decay lambda of the student, and the error of one step

    delta_t = r_t + gamma V(s_(t+1)) - V(s_t),    V = 0 where the episode terminated,

A_t is the generalised advantage, the sum of (gamma lambda)^i delta_(t+i). Every function gives one
number for each step, float64 [K, P, T]; a level's score is the mean over an episode's steps, then
over its episodes.

Sources: value losses: Jiang et al. 2021 (arXiv 2010.03934, section 3.1; 2110.02439, section 5);
MaxMC: the latter, appendix.
"""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.curricula.student import VALUE, Student, advantages


def positive_value_loss(student: Student, rollout: TensorDictBase, best: Tensor) -> Tensor:
    """max(A_t, 0): where the student does better than its critic expects."""
    return advantages(student, rollout).clamp_min(0)


def l1_value_loss(student: Student, rollout: TensorDictBase, best: Tensor) -> Tensor:
    """abs(A_t): where it does otherwise than its critic expects."""
    return advantages(student, rollout).abs()


def one_step_td_error(student: Student, rollout: TensorDictBase, best: Tensor) -> Tensor:
    """abs(delta_t)."""
    return advantages(student, rollout, lmbda=0.0).abs()


def max_mc(student: Student, rollout: TensorDictBase, best: Tensor) -> Tensor:
    """R - V(s_t), with the highest return R [K, P] ever seen on the level."""
    return best.unsqueeze(-1) - rollout[VALUE].squeeze(-1).double()


STEPWISE = {
    score.__name__: score
    for score in (
        positive_value_loss,
        l1_value_loss,
        one_step_td_error,
        max_mc,
    )
}
