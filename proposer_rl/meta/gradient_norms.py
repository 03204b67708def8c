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

import torch
from torch import Tensor

from proposer_rl.learning import PPO
from proposer_rl.meta.first_order import squared_length
from proposer_rl.streams import Streams
from proposer_rl.task import ExactTask, Levels


def squared_gradients(task: ExactTask, chunk: int = 16) -> Callable[[PPO, Levels], Tensor]:
    """Makes the function that scores levels, and a population for it to work with.

    The population has ``chunk`` Solvers. All of them become copies of one whose levels are to be
    scored, and each gets one level of its own. So the sum of their returns, differentiated once,
    gives each the gradient of its level.

    Args:
        task: of the Solvers and levels.
        chunk: levels at once, at least 1. As many networks, their gradients and their activations
            are in memory; where a Solver has fewer levels, the others are computed for nothing.

    Returns:
        A function of a learner of K Solvers, which it leaves as it is, and levels [K, n], each to
        be scored for its Solver: float [K, n], without gradients.

    Raises:
        ValueError: if ``chunk`` is less than 1.
    """
    if chunk < 1:
        raise ValueError(f"chunk must be at least 1, got {chunk}")
    agent = task.learner([Streams(0)] * chunk).agent
    parameters = dict(agent.named_parameters())

    def become(learner: PPO, solver: int) -> None:
        with torch.no_grad():
            for name, parameter in learner.agent.named_parameters():
                parameters[name].copy_(parameter[solver])

    def score(levels: Levels) -> Tensor:
        """Of at most ``chunk`` levels [m]: float [m]."""
        count = len(levels)
        # Filled up with the last one.
        number = torch.arange(chunk, device=task.device).clamp_(max=count - 1)
        with torch.enable_grad():
            performance = task.differentiable_performance(agent, levels[number].unsqueeze(-1))
            gradients = torch.autograd.grad(
                performance["return"].sum(),  # of [chunk, 1]
                list(parameters.values()),
                allow_unused=True,
                materialize_grads=True,
            )
        return squared_length(dict(zip(parameters, gradients, strict=True)))[:count]

    def scores(learner: PPO, levels: Levels) -> Tensor:
        found = []
        for solver in range(len(levels)):
            become(learner, solver)
            found.append(torch.cat([score(part) for part in levels[solver].split(chunk)]))
        return torch.stack(found)

    return scores
