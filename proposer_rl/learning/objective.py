"""PPO's settings, advantages, loss and gradients for K replicas at once.

All of it is TorchRL's, except for parts that would mix replicas or wait for a device. Metrics are
reported for each replica by itself, and numbers that are not finite raise an error. Rules that join
several settings are checked where the object that needs them is built.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any

import torch
from annotated_types import Ge, Gt, Interval
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent
from torchrl.objectives import ClipPPOLoss, LossModule
from torchrl.objectives.value import GAE
from torchrl.objectives.value.functional import reward2go

from proposer_rl.settings import settings

LEAST_DISCOUNT = 1e-7  # below this the next reward vanishes in float32


@settings
class LearningSettings:
    """PPO's numbers except the horizon; the defaults are the paper's for the Solver.

    Attributes:
        updates: number of updates on one batch; each recomputes advantages, then runs ``epochs``.
        epochs: passes of an update through its batch; each is one gradient step unless the batch is
            cut into minibatches.
        learning_rate, adam_eps: Adam's step size and denominator offset.
        gamma, lmbda: discount, and GAE's weight of longer returns (Schulman et al. 2016, eq. 16).
        clip_epsilon: the ratio is clipped to 1 +- this (Schulman et al. 2017, eq. 7).
        entropy_coeff, critic_coeff: weights of the entropy bonus and of the squared value error.
        max_grad_norm: largest gradient norm of one copy.
        normalize_advantage: whether to standardise advantages within each gradient step of a copy.
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
        continue_episodes: whether episodes go on from rollout to rollout, so that a new level
            begins when an episode ends; otherwise every rollout begins with new levels.
        normalize_observations: whether to standardise observations by the mean and the standard
            deviation of all that a replica has trained on, and clip them to [-10, 10].
        normalize_rewards: whether values are in units of the standard deviation of the discounted
            return, which is the same as dividing rewards by it.
        minibatches: number of equal parts of a batch, shuffled in each epoch, with a gradient step
            (and standardised advantages) each; 1 for the whole batch.
        anneal_updates: the learning rate falls linearly, update by update, to zero after this many
            updates; None for a constant one.
        anneal_clip: whether ``clip_epsilon`` falls with the learning rate.
        clip_value: the loss of the value is the larger of two squared errors: its own, and that of
            the value clipped to this distance from the rollout's; None for the plain squared error.
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
        batch_size: number P of levels in an update.
        ppo: PPO's numbers.
    """

    batch_size: Annotated[int, Ge(1)] = 128
    ppo: PPOSettings = PPOSettings()


def gae(gamma: float, lmbda: float, value_key: str) -> GAE:
    """Makes TorchRL's generalised advantage estimation for rollouts that contain values."""
    # The vectorised form splits the batch at the ends of episodes, and would wait for the device.
    estimator = GAE(gamma=gamma, lmbda=lmbda, value_network=None, vectorized=False)
    estimator.set_keys(value=value_key)
    return estimator


class LeaveOneOutBaseline(TensorDictModuleBase):
    """Computes advantages as returns minus the mean return of the other replicas.

    If all K episodes start from the same state, the mean return of the others is an unbiased
    estimate of that state's value, and a far better one than a critic has after a few episodes
    (Kool et al. 2019, "Buy 4 REINFORCE samples, get a baseline for free!", eq. 8). It replaces
    :class:`torchrl.objectives.value.GAE`; the returns are the targets of the critic.

    Args:
        gamma: discount.

    Example:
        Three replicas, one step each:

        >>> reward = torch.tensor([1.0, 2.0, 6.0]).view(3, 1, 1)
        >>> from tensordict import TensorDict
        >>> rollout = TensorDict({"next": {"reward": reward, "done": reward > 0}}, [3, 1])
        >>> LeaveOneOutBaseline(gamma=1.0)(rollout)["advantage"].flatten()
        tensor([-3.0000, -1.5000,  4.5000])
    """

    def __init__(self, gamma: float) -> None:
        super().__init__()
        self.in_keys = [("next", "reward"), ("next", "done")]
        self.out_keys = ["advantage", "value_target"]
        self.gamma = gamma

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``advantage`` and ``value_target``, [K, T, 1], into a rollout [K, T]."""
        copies = tensordict.batch_size[0]
        reward = tensordict["next", "reward"]
        # TorchRL's sum stops where a power of the discount is lost in rounding: here before its
        # first term.
        following = reward.clone()
        if self.gamma >= LEAST_DISCOUNT:
            following = reward2go(reward, tensordict["next", "done"], self.gamma)
        others = (following.sum(0, keepdim=True) - following) / (copies - 1)
        tensordict.set("advantage", following - others)
        return tensordict.set("value_target", following)


ACTED_VALUE = "acted_value"
"""Entry of the values at the time of acting, which a clipped value loss needs."""

# From an actor and a critic that read what stands in a tensordict already, to a loss of both.
MakeLoss = Callable[[TensorDictModuleBase, TensorDictModule], LossModule]


class CopiesClipLoss(ClipPPOLoss):
    """PPO's clipped loss of every transition, with advantages standardised for each replica.

    ``entropy``, ``kl_approx`` and ``clip_fraction`` are of every transition, too, while TorchRL's
    are means over all replicas.

    ``numbers`` are further arguments of :class:`torchrl.objectives.ClipPPOLoss`.
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        critic: TensorDictModule,
        *,
        copies: int | None,
        **numbers: Any,
    ) -> None:
        super().__init__(
            actor,
            critic,
            loss_critic_type="l2",
            normalize_advantage_exclude_dims=() if copies is None else (0,),
            functional=False,
            reduction="none",
            # TorchRL takes the variance over the first dimension only: see explained_variance.
            log_explained_variance=False,
            **numbers,
        )
        if numbers.get("clip_value") is not None:
            # TorchRL checks whether its tensor is zero, and would wait for the device.
            del self._buffers["clip_value"]
            self.clip_value = numbers["clip_value"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the terms and diagnostics of transitions [*B, T]."""
        self._each: dict[str, Tensor] = {}
        return super().forward(tensordict).update(self._each)

    def _log_weight(self, tensordict: TensorDictBase, adv_shape: torch.Size) -> tuple[Any, ...]:
        log_weight, distribution, kl_approx, correction = super()._log_weight(tensordict, adv_shape)
        ratio = log_weight.detach()
        clipped = ratio.clamp(*self._clip_bounds) != ratio
        self._each |= {"kl_approx": kl_approx.detach(), "clip_fraction": clipped.to(ratio)}
        return log_weight, distribution, kl_approx, correction

    def loss_critic(self, tensordict: TensorDictBase) -> tuple[Any, ...]:
        """Returns the critic's term, relative to the values at the time of acting."""
        self._acted_value = tensordict.get(ACTED_VALUE, None)
        return super().loss_critic(tensordict)

    def _critic_loss_inputs(
        self, target_return: Tensor, state_value: Tensor, old_state_value: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        return target_return, state_value, self._acted_value

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        # TorchRL checks that entropies are finite, and would wait; for discrete actions they are.
        if isinstance(dist, Categorical | Independent):
            entropy = dist.entropy().unsqueeze(-1)
        else:
            entropy = super()._get_entropy(dist, adv_shape)
        self._each["entropy"] = entropy.detach()
        return entropy


def of_copies(numbers: Tensor, copies: int | None) -> Tensor:
    """Averages over each replica's batch, [K] or []; a scalar stands for all replicas."""
    if copies is not None and not numbers.ndim:
        return numbers.expand(copies)
    return numbers.flatten(0 if copies is None else 1).mean(-1)


def explained_variance(steps: TensorDictBase, value_key: str, copies: int | None) -> Tensor:
    """Returns the share of the targets' variance that the values explain, [K] or []."""
    value, target = steps[value_key].detach(), steps["value_target"]
    batch = 0 if copies is None else 1
    residual, total = (x.flatten(batch).var(-1, correction=0) for x in (target - value, target))
    return 1 - residual / total.clamp_min(1e-12)


def clip_gradients_(parameters: list[nn.Parameter], max_norm: float, copies: int | None) -> Tensor:
    """Scales gradients (in place) so that no replica's norm exceeds ``max_norm``.

    Returns:
        The norms before clipping, [K], without replicas [].
    """
    if copies is None:
        return nn.utils.clip_grad_norm_(parameters, max_norm)
    gradients = [p.grad for p in parameters if p.grad is not None]
    # Slice by slice, because a norm over several rows is rounded differently from one row's.
    slices = [gradient[k] for k in range(copies) for gradient in gradients]
    norms = torch.stack(torch._foreach_norm(slices)).view(copies, len(gradients))
    norm = norms.square().sum(1).sqrt()  # [K]
    scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(scale.view(-1, *[1] * (gradient.ndim - 1)))
    return norm


class DivergedError(ArithmeticError):
    """A number is not finite; the message is one line that says which and in which replica."""

    exit_code = 3


def require_finite(
    reward: Tensor,
    steps: TensorDictBase,
    weights: Mapping[str, Tensor],
    copies: int | None,
    first: int = 0,
) -> None:
    """Checks that an update is finite; reads one number from the device if all is well.

    Args:
        reward: of the rollout, [B, ...], with B the first dimension of the environment.
        steps: losses ``loss_...`` and ``grad_norm`` of S gradient steps, [S, K], or without
            replicas [S].
        weights: after the update, by name, [K, ...] with replicas.
        copies: K, or None for a single network.
        first: number of the first replica, for naming replicas.

    Raises:
        DivergedError: naming what was not finite first, and the replicas that it happened in. The
            other replicas are not affected, because nothing is shared between them.
    """
    # What a gradient step leaves behind, in the order in which it arises.
    names = [*(key for key in steps.keys() if key.startswith("loss_")), "grad_norm"]
    scalars = [steps[name] for name in names]
    # A sum of magnitudes is finite only if all of them are.
    sums = nn.utils.get_total_norm([reward, *scalars, *weights.values()], norm_type=1.0)
    if bool(sums.isfinite()):
        return
    _require_finite("reward", reward, len(reward), first)
    for i in range(len(steps)):
        for name in names:
            _require_finite(f"{name} of gradient step {i}", steps[name][i], copies, first)
    for name, weight in weights.items():
        _require_finite(f"weight {name}", weight, copies, first)


@contextmanager
def located(place: str) -> Iterator[None]:
    """Adds to a :class:`DivergedError` raised inside where in the run it happened."""
    try:
        yield
    except DivergedError as error:
        raise DivergedError(f"{place}: {error}") from error


def _require_finite(name: str, tensor: Tensor, copies: int | None, first: int) -> None:
    finite = tensor.detach().isfinite().reshape(copies or 1, -1)
    if bool(finite.all()):
        return
    worst = float(tensor.detach().reshape(-1)[~finite.reshape(-1)][0])
    which = (first + torch.nonzero(~finite.all(1)).flatten()).tolist()
    named = "" if copies is None else f"copy {', '.join(map(str, which))}: "
    raise DivergedError(f"{named}{name} is not finite ({worst})")
