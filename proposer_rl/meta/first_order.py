"""Estimates from gradients how training on a level would change a Solver.

Training moves the parameters of a Solver from theta to theta + d, and the performance R on the
target by

    R(theta + d) - R(theta)  =  <grad R(theta), d> + O(|d|^2).

Adam's step is about d = rate * m / (sqrt(v) + eps), where v is its bias-corrected second moment and
m the mean of the gradients g_p of the returns of the batch's problems p. So to first order the gain
is the mean over problems of <u, g_p>, with

    u  =  grad R(theta) / (sqrt(v) + eps),

the *target direction*. The share <u, g_p> of problem p is its *alignment*. It is the derivative of
the problem's own return J_p along u,

    <u, g_p>  =  d/de J_p(theta + e u)  =  (J_p(theta + s u) - J_p(theta - s u)) / 2 s + O(s^2),

which takes two forward passes for any number of problems, even problems that nobody trained on.

Here u is scaled to a root mean square of 1 over the parameters of each Solver. So a step of ``s``
moves a parameter by about s, like a step of Adam with this learning rate. With a million parameters
that is a long way, along which returns are not linear: if s is the learning rate, the difference is
a secant, the effect of a step towards the target; with a twentieth of it, it is the derivative
(docs/explanation/first_order.md compares them).

Related work aligns gradients of training examples with those of a validation set: TracIn (Pruthi et
al. 2020, arXiv 2002.08484) and example weights (Ren et al. 2018, arXiv 1803.09050); in curricula,
SHED uses the mean gain over evaluation levels (arXiv 2310.00301).

Without a target, :class:`LevelGradients` measures how much training on one level alone would change
a Solver: |grad J_p(theta)|^2. It is zero if training would change nothing: on a level that the
policy cannot fail, and on one that it cannot solve. PACE (arXiv 2605.01358) scores a level with
|d|^2. Here it is the gradient of the return alone, without the loss of a critic, standardised
advantages or a clipped norm, which would hide its length. Nor is it Adam's step, whose first one
has a length of about rate * sqrt(number of parameters) for any gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal, cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from proposer_rl.learning import PPO, DivergedError, Replica, agent_values
from proposer_rl.meta.rewards import mean_log_success, mean_return
from proposer_rl.models import ActorCritic
from proposer_rl.streams import Streams
from proposer_rl.task import DifferentiableTask, Levels, Task

SECOND_MOMENT_DECAY = 0.999  # torch.optim.Adam's beta_2

Direction = Mapping[str, Tensor]
"""A direction in which to move the parameters of K Solvers: by name, [K, ...]."""

TargetMeasure = Literal["log_success", "return"]

LEVELS_AT_ONCE = 16
"""Levels at once in :class:`LevelGradients`, each with a network, gradients and activations."""

LevelValue = Callable[[ActorCritic, int, Tensor], Tensor]
"""From m agents, a Solver's number k and m places of its levels, int64 [m], to float [m]."""


def target_performance(performance: TensorDictBase, measure: str) -> Tensor:
    """Computes the performance R of K Solvers, float [K], on levels [K, E] of the target.

    Args:
        performance: with ``return`` or ``success``, and gradients.
        measure: ``"log_success"``, the mean of log(success + 0.001), which differs between Solvers
            from the first update on, or ``"return"``.

    Raises:
        DivergedError: if a Solver's success is exactly 0 on every level, which has no gradient.
        NoSuccessError: if the task has no success.
    """
    if measure == "return":
        return mean_return(performance)
    mean, success = mean_log_success(performance), performance["success"]
    _require_none(
        (success <= 0).all(1),
        f"the probability of success is exactly 0 on each of {success.shape[1]} levels of the "
        "target, so it has no gradient; try measure=return",
    )
    return mean


def target_direction(learner: PPO | Replica, performance: Tensor) -> dict[str, Tensor]:
    """Computes the target direction of K Solvers, each with a root mean square of 1.

    It is the gradient of the performance, divided by what Adam divides its step by. Before Adam's
    first step there is no second moment, and nothing is divided.

    Args:
        learner: provides the agent, and the state of Adam.
        performance: exact R of each Solver, float [K], with gradients to the agent's parameters;
            see :func:`target_performance`.

    Raises:
        DivergedError: if the gradient of a Solver is zero, or not finite.
    """
    parameters = trainable(learner.agent)
    gradients = torch.autograd.grad(
        performance.sum(), list(parameters.values()), allow_unused=True, materialize_grads=True
    )
    state = learner.snapshot()
    direction = {}
    for name, gradient in zip(parameters, gradients, strict=True):
        step = expand_as_right(state[name, "step"], gradient)
        bias = 1 - SECOND_MOMENT_DECAY**step
        moment = torch.where(step > 0, state[name, "exp_avg_sq"] / bias, torch.ones_like(gradient))
        direction[name] = gradient / (moment.sqrt() + learner.settings.adam_eps)
    size = root_mean_square(direction)
    _require_none(size == 0, "the target direction is zero")
    _require_none(~size.isfinite(), "the target direction is not finite")
    return {name: entry / expand_as_right(size, entry) for name, entry in direction.items()}


def trainable(agent: nn.Module) -> dict[str, nn.Parameter]:
    """Returns the parameters of an agent by name, without frozen ones."""
    return {name: p for name, p in agent.named_parameters() if p.requires_grad}


def _require_none(wrong: Tensor, why: str) -> None:
    """Raises a DivergedError that names the Solvers for which something is wrong, bool [K]."""
    if bool(wrong.any()):
        which = ", ".join(map(str, torch.nonzero(wrong).flatten().tolist()))
        raise DivergedError(f"copy {which}: {why}")


def squared_length(direction: Direction) -> Tensor:
    """Returns the sum of squares over all parameters of each Solver, float [K]."""
    return torch.stack([entry.square().flatten(1).sum(1) for entry in direction.values()]).sum(0)


def root_mean_square(direction: Direction) -> Tensor:
    """Returns the root mean square over all parameters of each Solver, float [K]."""
    return (squared_length(direction) / sum(e[0].numel() for e in direction.values())).sqrt()


@contextmanager
def moved_along(agent: ActorCritic, direction: Direction, step: float) -> Iterator[None]:
    """Moves K Solvers by ``step`` along a direction, and then restores them bit by bit."""
    parameters = trainable(agent)
    before = {name: parameter.detach().clone() for name, parameter in parameters.items()}
    try:
        with torch.no_grad():
            for name, parameter in parameters.items():
                parameter.add_(direction[name], alpha=step)
        yield
    finally:
        with torch.no_grad():
            for name, parameter in parameters.items():
                parameter.copy_(before[name])


@torch.no_grad()
def alignment(
    agent: ActorCritic, direction: Direction, step: float, gained: Callable[[], Tensor]
) -> Tensor:
    """Computes the slope of what K Solvers gain along a direction, by a central difference.

    It takes two forward passes of any kind of network, even one without forward-mode or second
    derivatives.

    Args:
        agent: the Solvers.
        direction: from :func:`target_direction`.
        step: of the difference, such as the learning rate.
        gained: returns what the agent gains with its current parameters, float [K, E], such as the
            exact return of levels.

    Returns:
        float [K, E].

    Example:
        The derivative of w^2 at 3 along the direction 1:

        >>> from tensordict.nn import TensorDictModule
        >>> from torch import nn
        >>> linear = TensorDictModule(nn.Linear(1, 1, bias=False), ["x"], ["y"])
        >>> w = nn.init.constant_(linear.module.weight, 3.0)
        >>> alignment(linear, {"module.weight": torch.ones(1, 1)}, 0.5, lambda: w.square())
        tensor([[6.]])
    """
    with moved_along(agent, direction, step):
        ahead = gained()
    with moved_along(agent, direction, -step):
        behind = gained()
    return (ahead - behind) / (2 * step)


def exact_direction(
    task: DifferentiableTask, learner: PPO | Replica, levels: Levels, measure: str
) -> tuple[Tensor, dict[str, Tensor]]:
    """Computes R of K Solvers on levels [K, E] of the target, float [K], and their directions.

    Raises:
        DivergedError: where :func:`target_performance` or :func:`target_direction` does.
    """
    with torch.enable_grad():
        performance = task.differentiable_performance(learner.agent, levels)
        reached = target_performance(performance, measure)
        return reached.detach(), target_direction(learner, reached)


def exact_alignment(
    task: DifferentiableTask,
    learner: PPO | Replica,
    direction: Direction,
    levels: Levels,
    step: float = 1.0,
) -> Tensor:
    """Computes the alignment of levels [K, E] by differences of ``step`` learning rates, [K, E]."""
    return alignment(
        learner.agent,
        direction,
        step * learner.settings.learning_rate,
        lambda: task.differentiable_performance(learner.agent, levels)["return"],
    )


def surrogate(agent: ActorCritic, rollout: TensorDictBase, advantage: Tensor) -> Tensor:
    """Averages A_t log pi(a_t | s_t) over the steps of each problem: float [K, P].

    Its gradient is the policy gradient of each problem.

    Args:
        agent: the Solvers.
        rollout: that they played, [K, P, T].
        advantage: of every step, float [K, P, T].
    """
    return over_steps(advantage * log_probabilities(agent, rollout), rollout)


def over_steps(values: Tensor, rollout: TensorDictBase) -> Tensor:
    """Averages values [K, P, T] over the steps of each problem: float [K, P].

    Episodes may be padded to one length; then ``is_step`` of the rollout, bool [K, P, T], says
    which steps were played.
    """
    if "is_step" not in rollout.keys():
        return values.mean(-1)
    played = rollout["is_step"]
    return values.where(played, 0).sum(-1) / played.sum(-1)


def log_probabilities(agent: ActorCritic, rollout: TensorDictBase) -> Tensor:
    """Returns log pi(a_t | s_t) of K Solvers for each step of a rollout [K, P, T]."""
    context = agent.encode(rollout.select(*agent.level_keys)[..., 0])
    with set_recurrent_mode(True):
        steps = agent.decode(rollout.select(*agent.step_keys), context)
    log_prob = agent.distribution(steps).log_prob(rollout[agent.action_key])
    # An action of several parts has one log-probability for each of them.
    return log_prob.reshape(*rollout.batch_size, -1).sum(-1)


def bin_scores(values: Tensor) -> tuple[Tensor, Tensor]:
    """Returns mean and standard error of each bin's alignments, float [K, N] each.

    Args:
        values: alignments of C candidates of each of N bins, float [K, N, C]. The standard error of
            a single one is infinite.
    """
    count = values.shape[-1]
    if count < 2:
        return values.mean(-1), torch.full_like(values[..., 0], torch.inf)
    return values.mean(-1), values.std(-1) / count**0.5


class LevelGradients:
    """Computes squared lengths of the gradients of single levels, many in one backward pass.

    A population of :data:`LEVELS_AT_ONCE` networks gets the weights of the Solver, and each network
    one of its levels. So one differentiation of the sum of their values gives each network the
    gradient of its level.

    Args:
        task: makes the population; the learners do not change.
    """

    def __init__(self, task: Task) -> None:
        self._task, self._agent = task, task.learner([Streams(0)] * LEVELS_AT_ONCE).agent

    def of_returns(self, learner: PPO | Replica, levels: Levels) -> Tensor:
        """Returns |grad|^2 of the exact return of levels; the task must be differentiable.

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

    def of_rollouts(
        self, learner: PPO | Replica, rollout: TensorDictBase, advantage: Tensor
    ) -> Tensor:
        """Returns |grad|^2 of the :func:`surrogate` of levels, from episodes on them.

        Noise makes an estimated gradient longer: short rollouts score higher than the exact
        gradient by the variance of the estimate.

        Args:
            learner: of K Solvers.
            rollout: what they played, [K, n, T].
            advantage: float [K, n, T].

        Returns:
            float [K, n], without gradients.
        """

        def gained(agent: ActorCritic, solver: int, which: Tensor) -> Tensor:
            steps = rollout[solver][which].unsqueeze(1)  # [m, 1, T]
            return surrogate(agent, steps, advantage[solver, which].unsqueeze(1)).squeeze(-1)

        return self.lengths(learner, gained, *rollout.batch_size[:2])

    def lengths(
        self, learner: PPO | Replica, value: LevelValue, solvers: int, count: int
    ) -> Tensor:
        """Returns |grad|^2 of any value of a level, for K Solvers with n levels each: [K, n]."""
        parameters = trainable(self._agent)
        parts = []
        for solver in range(solvers):
            self._become(learner, solver)
            for start in range(0, count, LEVELS_AT_ONCE):
                # Padded with the last one.
                which = torch.arange(
                    start, start + LEVELS_AT_ONCE, device=self._task.device
                ).clamp_(max=count - 1)
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
    def _become(self, learner: PPO | Replica, solver: int) -> None:
        own = agent_values(self._agent)
        for name, value in agent_values(learner.agent).items():
            own[name].copy_(value[solver])
