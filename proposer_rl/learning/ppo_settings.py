"""The numbers of PPO, and how a Solver is trained by it.

A rule that joins several settings stands where the object is built that needs it.
"""

from __future__ import annotations

from typing import Annotated

from annotated_types import Ge, Gt, Interval

from proposer_rl.settings import settings


@settings
class LearningSettings:
    """PPO's numbers but for the horizon; the defaults are the paper's for the Solver.

    Attributes:
        updates: updates on one batch; each computes advantages anew, then runs ``epochs``.
        epochs: passes of an update through its batch, each a gradient step where the batch is not
            cut in parts.
        learning_rate, adam_eps: Adam's step size and denominator offset.
        gamma, lmbda: discount, and GAE's weight of longer returns (Schulman et al. 2016, eq. 16).
        clip_epsilon: the ratio is clipped to 1 +- this (Schulman et al. 2017, eq. 7).
        entropy_coeff, critic_coeff: weights of the entropy bonus and of the squared value error.
        max_grad_norm: largest gradient norm of one copy.
        normalize_advantage: standardise advantages over what a gradient step of a copy is made on.
    """

    updates: Annotated[int, Ge(1)] = 1
    epochs: Annotated[int, Ge(1)] = 8
    learning_rate: Annotated[float, Gt(0)] = 2.5e-4
    adam_eps: Annotated[float, Gt(0)] = 1e-5
    gamma: Annotated[float, Interval(ge=0, le=1)] = 0.99
    lmbda: Annotated[float, Interval(ge=0, le=1)] = 0.95
    clip_epsilon: Annotated[float, Interval(gt=0, lt=1)] = 0.2
    entropy_coeff: Annotated[float, Ge(0)] = 0.01
    critic_coeff: Annotated[float, Ge(0)] = 0.5
    max_grad_norm: Annotated[float, Gt(0)] = 1.0
    normalize_advantage: bool = True


@settings
class PPOSettings(LearningSettings):
    """PPO's numbers, and how it goes through a batch.

    Attributes:
        horizon: steps T collected from every environment before an update.
        continue_episodes: whether episodes go on from rollout to rollout, and a new level begins
            where one ends; otherwise every rollout begins with its levels.
        normalize_observations: whether observations are standardised by the mean and the standard
            deviation of all that a replica has trained on, and clipped to [-10, 10].
        normalize_rewards: whether values are in units of the standard deviation of the discounted
            return, which is the same as dividing rewards by it.
        minibatches: equal parts of a batch, shuffled anew in each epoch, with a gradient step (and
            standardised advantages) each; 1 for the batch as it is.
        anneal_updates: the learning rate falls in equal steps, update by update, and would be zero
            after so many; None for a constant one.
        anneal_clip: whether ``clip_epsilon`` falls with the learning rate.
        clip_value: the value's loss is the larger of its squared error and that of the value
            clipped to this distance from the rollout's; None for the plain squared error.
    """

    horizon: Annotated[int, Ge(1)] = 25
    continue_episodes: bool = False
    normalize_observations: bool = False
    normalize_rewards: bool = False
    minibatches: Annotated[int, Ge(1)] = 1
    anneal_updates: Annotated[int, Ge(1)] | None = None
    anneal_clip: bool = False
    clip_value: Annotated[float, Gt(0)] | None = None


@settings
class SolverSettings:
    """Settings of the Solver's training.

    Attributes:
        batch_size: levels P of an update.
        ppo: PPO's numbers.
    """

    batch_size: Annotated[int, Ge(1)] = 128
    ppo: PPOSettings = PPOSettings()
