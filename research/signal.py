"""How much of a Proposer's reward is due to what was proposed, and how much to chance.

G proposals are each followed by R replicas of one Solver. The replicas of a proposal differ by
chance alone: other levels of the same specifications, other actions of the Solver. A one-way
analysis of variance with random effects splits the variance of their total gains into that between
proposals, which a Proposer can learn from, and that within, which it cannot.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch
from scipy.stats import f
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Dirichlet

from proposer_rl.meta.env import SolverTrainingEnv
from proposer_rl.streams import Streams
from proposer_rl.task import Levels

UNEVEN = 0.15  # concentration of the Dirichlet distribution


@dataclass(frozen=True)
class Signal:
    """Variance components of total gains.

    Attributes:
        mean: mean total gain.
        noise: standard deviation within a proposal.
        signal: standard deviation between proposals, 0 where the estimate is negative.
        ratio: signal-to-noise ratio, the quotient of the two variances, estimated without bias but
            for that cut at 0.
        low, high: its exact 95 % confidence interval for normal gains, cut at 0.
    """

    mean: float
    noise: float
    signal: float
    ratio: float
    low: float
    high: float


def variance_components(gains: Tensor) -> Signal:
    """One-way random-effects analysis of variance (Searle et al. 1992, sections 3.5 and 3.6).

    Args:
        gains: float [G, R], R replicas of each of G proposals.

    Raises:
        ValueError: for fewer than two proposals or two replicas of each.

    Example:
        Two proposals that differ much, and two replicas of each that do not:

        >>> signal = variance_components(torch.tensor([[0.1, 0.2], [0.6, 0.7]]))
        >>> round(signal.noise, 3), round(signal.signal, 3)
        (0.071, 0.35)
    """
    groups, replicates = gains.shape
    if min(groups, replicates) < 2:
        raise ValueError(
            f"at least 2 proposals and 2 replicas of each are needed, got {groups} and {replicates}"
        )
    gains = gains.double()
    within = float(gains.var(1).mean())
    quotient = replicates * float(gains.mean(1).var()) / max(within, 1e-300)
    freedom = (groups - 1, groups * (replicates - 1))

    def ratio(quotient: float) -> float:
        return max(0.0, (quotient - 1) / replicates)

    # The quotient over its expectation has an F distribution; the estimate of 1 / within is biased
    # by the factor that is divided out.
    unbiased = quotient * (freedom[1] - 2) / freedom[1] if freedom[1] > 2 else quotient
    return Signal(
        mean=float(gains.mean()),
        noise=within**0.5,
        signal=(within * ratio(quotient)) ** 0.5,
        ratio=ratio(unbiased),
        low=ratio(quotient / float(f.ppf(0.975, *freedom))),
        high=ratio(quotient / float(f.ppf(0.025, *freedom))),
    )


def uneven_shares(shape: Sequence[int], bins: int) -> Tensor:
    """Shares of very uneven mixtures, which differ as much as proposals can.

    They are drawn from torch's default generator, since its Dirichlet takes no other: see
    :meth:`Streams.as_default`.

    Returns:
        Float ``[*shape, bins]``, each at least 1e-6, so that they have logarithms.
    """
    return Dirichlet(torch.full((bins,), UNEVEN)).sample(torch.Size(shape)).clamp_min(1e-6)


@torch.no_grad()
def performance_at(
    steps: Collection[int],
    env: SolverTrainingEnv,
    solver: TensorDictBase,
    actions: Tensor,
    levels: Levels,
    streams: Streams,
) -> list[TensorDictBase]:
    """Performance of replicas of a Solver along one episode, level by level.

    Args:
        steps: of the episode, after which it is measured, ascending from 0 on.
        env: the meta-environment, batch [K] with K = G * R.
        solver: a snapshot of one Solver, batch [].
        actions: those of G proposals in an episode of T steps, [T, G, ...]; R replicas follow each.
        levels: on which it is measured, [E].
        streams: of all randomness, which is different for every replica.

    Returns:
        A tensordict [G, R, E] for each of the steps.
    """
    groups = actions.shape[1]
    replicates = env.batch_size[0] // groups
    task = env.view.task

    def measured() -> TensorDictBase:
        generator = streams.generator("gain")
        performance = task.performance(env.solvers.agent, levels, generator)
        return performance.clone().unflatten(0, (groups, replicates))

    env.fork(solver, streams)
    found = [measured()] if 0 in steps else []
    state = env.reset()
    for step, action in enumerate(actions.repeat_interleave(replicates, 1), 1):
        _, state = env.step_and_maybe_reset(state.set("action", action))
        if step in steps:
            found.append(measured())
    return found


def by_validation_size(gains: Tensor, sizes: Sequence[int]) -> dict[int, Signal]:
    """Variance components as a validation batch of each size would see them.

    Args:
        gains: float [G, R, E], of E levels.
        sizes: numbers of levels, each at most E.

    Raises:
        ValueError: if a size is out of range.
    """
    most = gains.shape[-1]
    wrong = [size for size in sizes if not 1 <= size <= most]
    if wrong:
        raise ValueError(f"a validation size must be 1 to {most}, got {wrong[0]}")
    return {size: variance_components(gains[..., :size].mean(-1)) for size in sizes}
