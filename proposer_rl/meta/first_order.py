"""First-order performance gain: what levels bring a Solver, without training replicas of it.

Training moves a Solver's parameters from theta to theta + d, and the performance R on the target by

    R(theta + d) - R(theta)  =  <grad R(theta), d> + O(|d|^2).

Adam's step is about d = rate * m / (sqrt(v) + eps), v its bias-corrected second moment and m the
mean over the batch's problems p of the gradients g_p of their returns. So to first order the gain
is the mean over problems of <u, g_p>, with

    u  =  grad R(theta) / (sqrt(v) + eps),

the *target direction*. The share <u, g_p> of problem p is its *alignment*. It is the derivative of
the problem's own return J_p along u,

    <u, g_p>  =  d/de J_p(theta + e u)  =  (J_p(theta + s u) - J_p(theta - s u)) / 2 s + O(s^2),

two forward passes for any number of problems, also of such that nobody has trained on. Where J_p
is not known exactly, the surrogate of episodes takes its place: with advantages A_t,

    <u, g_p>  is estimated by  d/de sum over t of A_t log pi_(theta + e u)(a_t | s_t).

Here u is scaled to a root mean square of 1 over the parameters of each Solver: a step of ``s`` then
moves a parameter by about s, as a step of Adam with that learning rate does. For a million
parameters together that is a long way, on which returns are no straight lines: with s the learning
rate the difference is a secant, what a step towards the target changes, and with a twentieth of it
the derivative (docs/explanation/first_order.md compares them).

Relatives: gradients of training examples aligned with those of a validation set: TracIn (Pruthi et
al. 2020, arXiv 2002.08484), example weights (Ren et al. 2018, arXiv 1803.09050); in curricula the
mean gain over evaluation levels: SHED (arXiv 2310.00301), the norm |d|^2 without a direction: PACE
(arXiv 2605.01358).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Literal, get_args

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from proposer_rl.learning import PPO, DivergedError
from proposer_rl.meta.rewards import mean_log_success, mean_return
from proposer_rl.models import ActorCritic
from proposer_rl.task import DifferentiableTask, Levels

SECOND_MOMENT_DECAY = 0.999  # torch.optim.Adam's beta_2

Direction = Mapping[str, Tensor]
"""By the parameters' names, [K, ...]: a direction in which K Solvers can be moved."""

Measure = Literal["log_success", "return"]


def target_performance(performance: TensorDictBase, measure: str) -> Tensor:
    """R of K Solvers from their performance on levels [K, E] of the target: float [K].

    Args:
        performance: with ``return`` or ``success``, and gradients.
        measure: ``"log_success"``, the mean of log(success + 0.001), which tells something from the
            first update on, or ``"return"``.

    Raises:
        DivergedError: if a Solver's success is exactly 0 on every level: then nothing points
            towards more of it.
        NoSuccessError: if the task tells no success.
        ValueError: for another measure.
    """
    if measure == "return":
        return mean_return(performance)
    if measure not in get_args(Measure):
        known = " or ".join(get_args(Measure))
        raise ValueError(f"measure={measure!r}: must be {known}")
    mean, success = mean_log_success(performance), performance["success"]
    _refuse(
        (success <= 0).all(1),
        f"the probability of success is exactly 0 on each of {success.shape[1]} levels of the "
        "target, so that nothing points towards it; measure=return may",
    )
    return mean


def target_direction(learner: PPO, performance: Tensor) -> dict[str, Tensor]:
    """The target direction of K Solvers, each scaled to a root mean square of 1.

    Args:
        learner: whose agent the performance is of.
        performance: exact R of each Solver, float [K], with gradients towards the agent's
            parameters; see :func:`target_performance`.

    Raises:
        DivergedError: if the gradient of a Solver is zero, or not finite.
    """
    direction = in_adams_units(learner, performance)
    _refuse(root_mean_square(direction) == 0, "the target direction is zero")
    return scaled(direction)


def in_adams_units(learner: PPO, performance: Tensor) -> dict[str, Tensor]:
    """The gradient of a performance, each parameter's divided by what Adam divides its step by.

    Before Adam's first step, when there is no second moment, it is the gradient itself.

    Args:
        learner: whose agent the performance is of, and whose Adam says how steps are scaled.
        performance: of each Solver, float [K], with gradients towards the agent's parameters.
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
    return direction


def trainable(agent: nn.Module) -> dict[str, nn.Parameter]:
    """The parameters of an agent by their names, without those that are frozen."""
    return {name: p for name, p in agent.named_parameters() if p.requires_grad}


def scaled(direction: Direction) -> dict[str, Tensor]:
    """A direction of K Solvers, each brought to a root mean square of 1; what is zero stays.

    Raises:
        DivergedError: if that of a Solver is not finite.
    """
    size = root_mean_square(direction)
    _refuse(~size.isfinite(), "the target direction is not finite")
    size = torch.where(size > 0, size, torch.ones_like(size))
    return {name: entry / expand_as_right(size, entry) for name, entry in direction.items()}


def _refuse(wrong: Tensor, why: str) -> None:
    """Raise :class:`DivergedError` if anything is wrong with a Solver, bool [K]."""
    if bool(wrong.any()):
        which = ", ".join(map(str, torch.nonzero(wrong).flatten().tolist()))
        raise DivergedError(f"copy {which}: {why}")


def squared_length(direction: Direction) -> Tensor:
    """Sum of squares over all the parameters of each Solver: float [K]."""
    return torch.stack([entry.square().flatten(1).sum(1) for entry in direction.values()]).sum(0)


def root_mean_square(direction: Direction) -> Tensor:
    """Over all the parameters of each Solver: float [K]."""
    return (squared_length(direction) / sum(e[0].numel() for e in direction.values())).sqrt()


@contextmanager
def moved(agent: ActorCritic, direction: Direction, step: float) -> Iterator[None]:
    """K Solvers that stand ``step`` along a direction; afterwards they are bit by bit as before."""
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
    """The slope along a direction of what K Solvers get, by a central difference.

    Two forward passes do on any kind of network, also where neither forward-mode nor second
    derivatives exist.

    Args:
        agent: the Solvers.
        direction: as :func:`target_direction` makes it.
        step: of the difference, such as the learning rate.
        gained: what the agent gets as it stands, such as the exact return of levels, or
            :func:`surrogate`: float [K, E].

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
    with moved(agent, direction, step):
        ahead = gained()
    with moved(agent, direction, -step):
        behind = gained()
    return (ahead - behind) / (2 * step)


def exact_direction(
    task: DifferentiableTask, learner: PPO, levels: Levels, measure: str
) -> tuple[Tensor, dict[str, Tensor]]:
    """Performance R of K Solvers on levels [K, E] of the target, float [K], and its direction.

    Raises:
        DivergedError: as :func:`target_performance` and :func:`target_direction`.
    """
    with torch.enable_grad():
        performance = task.differentiable_performance(learner.agent, levels)
        reached = target_performance(performance, measure)
        return reached.detach(), target_direction(learner, reached)


def exact_alignment(
    task: DifferentiableTask, learner: PPO, direction: Direction, levels: Levels, step: float = 1.0
) -> Tensor:
    """Alignment of levels [K, E], by differences of ``step`` learning rates: float [K, E]."""
    return alignment(
        learner.agent,
        direction,
        step * learner.settings.learning_rate,
        lambda: task.differentiable_performance(learner.agent, levels)["return"],
    )


def surrogate(agent: ActorCritic, rollout: TensorDictBase, advantage: Tensor) -> Tensor:
    """Mean over the steps of each problem of A_t log pi(a_t | s_t): float [K, P].

    Its gradient is the policy gradient of each problem; the mean over problems is the batch's.

    Args:
        agent: the Solvers, where gradients are enabled with gradients.
        rollout: what they played, [K, P, T].
        advantage: of every step, float [K, P, T].
    """
    return over_steps(advantage * log_probabilities(agent, rollout), rollout)


def over_steps(values: Tensor, rollout: TensorDictBase) -> Tensor:
    """Mean over the steps of each problem, float [K, P], of values [K, P, T].

    Episodes of several lengths are filled up to one rollout; its ``is_step``, bool [K, P, T], says
    what is played. Without it all is.
    """
    if "is_step" not in rollout.keys():
        return values.mean(-1)
    played = rollout["is_step"]
    return values.where(played, 0).sum(-1) / played.sum(-1)


def log_probabilities(agent: ActorCritic, rollout: TensorDictBase) -> Tensor:
    """Log pi(a_t | s_t) of what K Solvers played, rollout [K, P, T]: float [K, P, T]."""
    context = agent.encode(rollout.select(*agent.level_keys)[..., 0])
    with set_recurrent_mode(True):
        steps = agent.decode(rollout.select(*agent.step_keys), context)
    log_prob = agent.distribution(steps).log_prob(rollout[agent.action_key])
    # An action of several parts has one log-probability for each of them.
    return log_prob.reshape(*rollout.batch_size, -1).sum(-1)


def bin_scores(values: Tensor) -> tuple[Tensor, Tensor]:
    """Score of each bin, and its standard error, from its candidates' alignments.

    Args:
        values: float [K, N, C] of C candidates of each of N bins.

    Returns:
        The means and their standard errors, float [K, N]; of one candidate the error is infinite.
    """
    count = values.shape[-1]
    if count < 2:
        return values.mean(-1), torch.full_like(values[..., 0], torch.inf)
    return values.mean(-1), values.std(-1) / count**0.5
