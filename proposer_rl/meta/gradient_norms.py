"""How much training on one level alone would change a Solver: the length of its return's gradient.

With J(theta, level) the exact expected return of the policy with parameters theta, the score is

    |grad_theta J(theta, level)|^2.

It is zero where training would change nothing: on a level that the policy cannot fail, and on one
that it cannot solve. PACE (arXiv 2605.01358) scores a level with |d|^2, d being the change of the
parameters that training on it causes. Here d is the gradient of the policy's return: no critic's
loss is in it, no standardised advantages and no clipped norm, which hide how long it is, and it is
not Adam's step, whose first one has a length of about rate * sqrt(number of parameters) whatever
the gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning import PPO
from proposer_rl.learning.snapshot import agent_values
from proposer_rl.meta.first_order import squared_length, surrogate
from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask, Levels, Task

AT_ONCE = 16
"""Levels: as many networks, their gradients and their activations are in memory."""

Value = Callable[[ActorCritic, int, Tensor], Tensor]
"""Of m agents in a population, a Solver and the places of m of its levels, int64 [m]: float [m]."""


def squared_gradients(task: Task) -> Callable[[PPO, Levels], Tensor]:
    """Makes the function that scores levels by the gradient of their exact return.

    Args:
        task: a :class:`~proposer_rl.task.DifferentiableTask`.

    Returns:
        A function of a learner of K Solvers, which it leaves as it is, and levels [K, n], each to
        be scored for its Solver: float [K, n], without gradients.
    """
    lengths, exact = level_gradients(task), cast(DifferentiableTask, task)

    def score(learner: PPO, levels: Levels) -> Tensor:
        def returns(agent: ActorCritic, solver: int, which: Tensor) -> Tensor:
            some = levels[solver, which].unsqueeze(-1)
            return exact.differentiable_performance(agent, some)["return"].squeeze(-1)

        return lengths(learner, returns, *levels.batch_size)

    return score


def squared_policy_gradients(
    task: Task,
) -> Callable[[PPO, TensorDictBase, Tensor], Tensor]:
    """Makes the function that scores levels by the policy gradient of episodes on them.

    The estimate of a level's gradient has the length of its noise, too: short rollouts score higher
    than the exact gradient by its variance.

    Returns:
        A function of a learner of K Solvers, a rollout [K, n, T] of theirs and its advantages,
        float [K, n, T]: float [K, n], the squared length of the gradient of the mean over the steps
        of A_t log pi(a_t | s_t).
    """
    lengths = level_gradients(task)

    def score(learner: PPO, rollout: TensorDictBase, advantage: Tensor) -> Tensor:
        def gained(agent: ActorCritic, solver: int, which: Tensor) -> Tensor:
            steps = rollout[solver][which].unsqueeze(1)  # [m, 1, T]
            return surrogate(agent, steps, advantage[solver, which].unsqueeze(1)).squeeze(-1)

        return lengths(learner, gained, *rollout.batch_size[:2])

    return score


def level_gradients(task: Task) -> Callable[[PPO, Value, int, int], Tensor]:
    """Makes what takes the gradient of each level by itself, and a population for it to work with.

    The population has :data:`AT_ONCE` Solvers. All of them become copies of one whose levels are to
    be scored, and each gets one level of its own. So the sum of their values, differentiated once,
    gives each the gradient of its level.

    Returns:
        A function of a learner of K Solvers, the value of a level, K, and the number n of levels
        of each: the squared lengths of its gradients, float [K, n].
    """
    agent = task.learner([Streams(0)] * AT_ONCE).agent
    parameters, values = dict(agent.named_parameters()), agent_values(agent)

    def become(learner: PPO, solver: int) -> None:
        with torch.no_grad():
            for name, value in agent_values(learner.agent).items():
                values[name].copy_(value[solver])

    def lengths(learner: PPO, value: Value, solvers: int, count: int) -> Tensor:
        parts = []
        for solver in range(solvers):
            become(learner, solver)
            for start in range(0, count, AT_ONCE):
                # Filled up with the last one.
                which = torch.arange(start, start + AT_ONCE, device=task.device).clamp_(
                    max=count - 1
                )
                with torch.enable_grad():
                    gradients = torch.autograd.grad(
                        value(agent, solver, which).sum(),
                        list(parameters.values()),
                        allow_unused=True,
                        materialize_grads=True,
                    )
                named = dict(zip(parameters, gradients, strict=True))
                parts.append(squared_length(named)[: count - start])
        return torch.cat(parts).unflatten(0, (solvers, count))

    return lengths
