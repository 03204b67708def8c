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

from proposer_rl.learning import PPO, agent_values
from proposer_rl.meta.first_order import squared_length, surrogate, trainable
from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask, Levels, Task

AT_ONCE = 16
"""Levels: as many networks, their gradients and their activations are in memory."""

Value = Callable[[ActorCritic, int, Tensor], Tensor]
"""Of m agents in a population, a Solver and the places of m of its levels, int64 [m]: float [m]."""


class LevelGradients:
    """Squared lengths of the gradients of single levels, and a population to take them with.

    The population has :data:`AT_ONCE` Solvers. All of them become copies of one whose levels are to
    be scored, and each gets one level of its own. So the sum of their values, differentiated once,
    gives each the gradient of its level.

    Args:
        task: whose learners' levels are scored; the learners are left as they are.
    """

    def __init__(self, task: Task) -> None:
        self._task, self._agent = task, task.learner([Streams(0)] * AT_ONCE).agent

    def of_returns(self, learner: PPO, levels: Levels) -> Tensor:
        """Of the exact return, where the task is a :class:`~proposer_rl.task.DifferentiableTask`.

        Args:
            learner: of K Solvers.
            levels: [K, n], each to be scored for its Solver.

        Returns:
            float [K, n], without gradients.
        """
        task = cast(DifferentiableTask, self._task)

        def returns(agent: ActorCritic, solver: int, which: Tensor) -> Tensor:
            some = levels[solver, which].unsqueeze(-1)
            return task.differentiable_performance(agent, some)["return"].squeeze(-1)

        return self.lengths(learner, returns, *levels.batch_size)

    def of_rollouts(self, learner: PPO, rollout: TensorDictBase, advantage: Tensor) -> Tensor:
        """Of the mean over the steps of A_t log pi(a_t | s_t): the policy gradient of episodes.

        The estimate of a level's gradient has the length of its noise, too: short rollouts score
        higher than the exact gradient by its variance.

        Args:
            learner: of K Solvers.
            rollout: of theirs, [K, n, T].
            advantage: float [K, n, T].

        Returns:
            float [K, n], without gradients.
        """

        def gained(agent: ActorCritic, solver: int, which: Tensor) -> Tensor:
            steps = rollout[solver][which].unsqueeze(1)  # [m, 1, T]
            return surrogate(agent, steps, advantage[solver, which].unsqueeze(1)).squeeze(-1)

        return self.lengths(learner, gained, *rollout.batch_size[:2])

    def lengths(self, learner: PPO, value: Value, solvers: int, count: int) -> Tensor:
        """Of any value of a level, for K Solvers with n levels each: float [K, n]."""
        parameters = trainable(self._agent)
        parts = []
        for solver in range(solvers):
            self._become(learner, solver)
            for start in range(0, count, AT_ONCE):
                # Filled up with the last one.
                which = torch.arange(start, start + AT_ONCE, device=self._task.device).clamp_(
                    max=count - 1
                )
                with torch.enable_grad():
                    gradients = torch.autograd.grad(
                        value(self._agent, solver, which).sum(),
                        list(parameters.values()),
                        allow_unused=True,
                        materialize_grads=True,
                    )
                named = dict(zip(parameters, gradients, strict=True))
                parts.append(squared_length(named)[: count - start])
        return torch.cat(parts).unflatten(0, (solvers, count))

    @torch.no_grad()
    def _become(self, learner: PPO, solver: int) -> None:
        own = agent_values(self._agent)
        for name, value in agent_values(learner.agent).items():
            own[name].copy_(value[solver])
