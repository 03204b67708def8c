"""Students of loops: made of the loop's own functions, or of an actor and a critic."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.curricula import Student
from proposer_rl.curricula.batches import moved
from proposer_rl.curricula.student import VALUE, advantages
from proposer_rl.meta.first_order import Direction, alignment, over_steps, trainable
from proposer_rl.settings import ArgumentError

OF_LEVELS = ("optimal_return", "exact_performance", "performance", "play")


def adapted(
    name: str,
    function: Any,
    given: Callable[[Any], Any],
    device: torch.device | None = None,
) -> Any:
    """Returns a function of levels [1, n] that calls a loop's own function of levels [n].

    Args:
        name: of the function; see :class:`~proposer_rl.curricula.Student`.
        function: of a loop, called with levels as the loop gets them.
        given: makes these of levels.
        device: on which it gets them; None to leave them where they are.

    Raises:
        ArgumentError: if it is no function.
    """
    if name not in OF_LEVELS:
        return function
    if not callable(function):
        raise ArgumentError(f"{name}={function!r:.60}: must be a function of levels")

    def of_one(levels: Any, *more: Any) -> Any:
        some = levels[0] if levels.ndim > 1 else levels
        some = some if device is None else moved(some, device)
        draws = [more[0][0]] if name == "play" else []
        found = function(given(some.clone()), *draws)  # which may change them
        if isinstance(found, TensorDictBase):
            return found if found.ndim > 2 else found.unsqueeze(0)
        if isinstance(found, dict):
            entries = {key: torch.as_tensor(entry).float() for key, entry in found.items()}
            return TensorDict(entries, some.shape).unsqueeze(0)
        return torch.as_tensor(found).unsqueeze(0)

    return of_one


class ActorStudent(Student):
    """One student that is an actor, a critic and an optimiser of TorchRL's or of one's own.

    It can do what first-order gain from episodes asks for, ``first_order_sampled``:
    ``sampled_direction`` and ``sampled_alignment``; see :mod:`proposer_rl.meta.first_order` for the
    formulas. With ``can`` it can do more.

    Args:
        actor: a :class:`~torchrl.modules.ProbabilisticActor`.
        critic: writes ``state_value``.
        optimizer: of the actor's parameters. Where it is an Adam, its second moments say how far a
            step along each of them goes; else the direction is that of the gradient. Its learning
            rate is the step of the differences.
        given: from levels inside to levels as the functions in ``can`` take them; that of the
            space. Only for these.
        gamma, lmbda: discount, and decay of the traces of generalised advantages.
        can: further functions, see :class:`~proposer_rl.curricula.Student`; such as ``play``,
            where ``play(levels, generator)`` gives a rollout [n, T] of the actor on levels [n].
    """

    def __init__(
        self,
        actor: Any,
        critic: Any,
        optimizer: torch.optim.Optimizer,
        *,
        given: Callable[[Any], Any] = lambda levels: levels,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        **can: Any,
    ) -> None:
        super().__init__(
            gamma=gamma,
            lmbda=lmbda,
            sampled_direction=self._sampled_direction,
            sampled_alignment=self._sampled_alignment,
            **{name: adapted(name, one, given) for name, one in can.items()},
        )
        self._actor, self._critic, self._optimizer = actor, critic, optimizer

    def _sampled_direction(self, rollout: TensorDictBase, weights: Tensor) -> dict[str, Tensor]:
        advantage = self._advantage(rollout)
        parameters = trainable(self._actor)
        with torch.enable_grad():
            gained = self._gained(rollout, advantage) * weights.to(advantage)
            gradients = torch.autograd.grad(
                gained.sum(), list(parameters.values()), allow_unused=True, materialize_grads=True
            )
        return {  # of one student
            name: (gradient / self._scale(parameter)).unsqueeze(0)
            for (name, parameter), gradient in zip(parameters.items(), gradients, strict=True)
        }

    def _sampled_alignment(self, direction: Direction, rollout: TensorDictBase) -> TensorDict:
        gained = partial(self._gained, rollout, self._advantage(rollout))
        step = self._optimizer.param_groups[0]["lr"]
        own = {name: entry[0] for name, entry in direction.items()}
        slope = alignment(self._actor, own, step, gained)
        return TensorDict({"slope": slope}, slope.shape)

    def _advantage(self, rollout: TensorDictBase) -> Tensor:
        if VALUE not in rollout.keys() or VALUE not in rollout["next"].keys():
            rollout = rollout.copy()
            with torch.no_grad():
                rollout[VALUE] = self._critic(rollout.copy())[VALUE]
                rollout["next", VALUE] = self._critic(rollout["next"].copy())[VALUE]
        return advantages(self, rollout).float()

    def _gained(self, rollout: TensorDictBase, advantage: Tensor) -> Tensor:
        """Returns the means over the steps of A_t log pi(a_t | s_t), [1, n]."""
        log_prob = self._actor.get_dist(rollout.copy()).log_prob(rollout["action"])
        log_prob = log_prob.reshape(*rollout.batch_size, -1).sum(-1)
        return over_steps(advantage * log_prob, rollout)

    def _scale(self, parameter: Tensor) -> Tensor:
        """Returns what Adam divides a gradient by; 1 where there is no second moment."""
        state = self._optimizer.state.get(parameter, {})
        if "exp_avg_sq" not in state:
            return torch.ones_like(parameter)
        groups = self._optimizer.param_groups
        group = next(g for g in groups if any(p is parameter for p in g["params"]))
        bias = 1 - group["betas"][1] ** float(state["step"])
        return (state["exp_avg_sq"] / bias).sqrt() + group["eps"]
