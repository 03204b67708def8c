"""What PPO maximises, for K replicas at once: advantages, the clipped loss, clipped gradients.

All of it is TorchRL's, without what would mix replicas or wait for a device; what is reported of a
step is of each replica by itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent
from torchrl.objectives import ClipPPOLoss, LossModule
from torchrl.objectives.value import GAE
from torchrl.objectives.value.functional import reward2go

from proposer_rl.models import ActorCritic

LEAST_DISCOUNT = 1e-7  # below it, float32 does not know the next reward from none


def gae(gamma: float, lmbda: float, value_key: str) -> GAE:
    """Returns TorchRL's generalised advantage estimation, of values that stand in the rollout."""
    # Its vectorised form splits the batch where episodes end, which it has to look up.
    estimator = GAE(gamma=gamma, lmbda=lmbda, value_network=None, vectorized=False)
    estimator.set_keys(value=value_key)
    return estimator


class LeaveOneOutBaseline(TensorDictModuleBase):
    """The return to come, minus what the other replicas had to come at the same step.

    Where all K episodes start from one state, the others' mean return is an unbiased estimate of
    that state's value, and a far better one than a critic that has seen a few episodes
    (Kool et al. 2019, "Buy 4 REINFORCE samples, get a baseline for free!", eq. 8). It takes the
    place of :class:`torchrl.objectives.value.GAE`: the returns are the critic's targets.

    Args:
        gamma: discount.

    Raises:
        ValueError: when called on fewer than two replicas.

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
        if copies < 2:
            raise ValueError("a baseline from the other copies needs at least 2 copies, got 1")
        reward = tensordict["next", "reward"]
        # TorchRL's sum breaks off where a power of the discount is lost in rounding: here before
        # the first term.
        following = reward.clone()
        if self.gamma >= LEAST_DISCOUNT:
            following = reward2go(reward, tensordict["next", "done"], self.gamma)
        others = (following.sum(0, keepdim=True) - following) / (copies - 1)
        tensordict.set("advantage", following - others)
        return tensordict.set("value_target", following)


ACTED_VALUE = "acted_value"
"""Entry of the values that the critic had when it acted, which a clipped value loss compares to."""

# From an actor and a critic that read what stands in a tensordict already, to a loss of both.
MakeLoss = Callable[[TensorDictModuleBase, TensorDictModule], LossModule]


def make_loss(make: MakeLoss, agent: ActorCritic) -> LossModule:
    """Returns the loss of an agent's actor and critic, which reads what the agent writes.

    Raises:
        ValueError: if it reduces what belongs to different replicas.
    """
    loss = make(*agent.readout())
    if loss.reduction != "none":
        raise ValueError(f'reduction of the loss must be "none", got {loss.reduction!r}')
    loss.set_keys(
        action=agent.action_key, sample_log_prob=agent.log_prob_key, value=agent.value_key
    )
    return loss.to(next(agent.parameters()).device)


class CopiesClipLoss(ClipPPOLoss):
    """The clipped loss of every transition, with advantages standardised over each replica's batch.

    ``entropy``, ``kl_approx`` and ``clip_fraction`` are of every transition, too, where TorchRL's
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
            # TorchRL's takes the variance over the first dimension alone: see explained_variance.
            log_explained_variance=False,
            **numbers,
        )
        if numbers.get("clip_value") is not None:
            # TorchRL asks its tensor whether it is zero, and waits.
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
        """Returns the critic's term; its old values are those with which the agent acted."""
        self._acted_value = tensordict.get(ACTED_VALUE, None)
        return super().loss_critic(tensordict)

    def _critic_loss_inputs(
        self, target_return: Tensor, state_value: Tensor, old_state_value: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        return target_return, state_value, self._acted_value

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        # TorchRL's checks that an entropy is finite, and waits: for discrete actions it is.
        if isinstance(dist, Categorical | Independent):
            entropy = dist.entropy().unsqueeze(-1)
        else:
            entropy = super()._get_entropy(dist, adv_shape)
        self._each["entropy"] = entropy.detach()
        return entropy


def of_copies(numbers: Tensor, copies: int | None) -> Tensor:
    """Returns means over each replica's batch, [K] or []; a scalar stands for all replicas."""
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
    # Slice by slice, since a norm over a row of several is rounded otherwise than over one alone.
    slices = [gradient[k] for k in range(copies) for gradient in gradients]
    norms = torch.stack(torch._foreach_norm(slices)).view(copies, len(gradients))
    norm = norms.square().sum(1).sqrt()  # [K]
    scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(scale.view(-1, *[1] * (gradient.ndim - 1)))
    return norm
