"""An actor-critic that reads a level once and its steps many times.

Also the running moments by which observations and values are normalised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution, Independent, Normal
from torchrl import data
from torchrl.envs import TensorDictPrimer


class ActorCritic(TensorDictModuleBase):
    """Writes action logits and a state value; its ``encoder`` depends on the level alone.

    Called as a module it is an ordinary TorchRL actor-critic: it reads one observation per step,
    and writes ``logits`` and ``state_value``. If the inputs of the encoder are the same throughout
    a rollout, :meth:`encode` runs the encoder once and :meth:`decode` computes all steps from that
    context, with the same numbers and T times less arithmetic.

    Args:
        head: reads the encoder's outputs and the observation of a step, and writes ``logits_key``
            and ``value_key``. With an encoder, every other input may have time dimensions after the
            batch dimensions, [*B, *T, ...], and then the outputs have them too.
        encoder: reads what is constant within a level; None if nothing is.
        distribution_class: builds the action's distribution from ``logits=``.
        copies: K if parameters and data have independent replicas as their first dimension
            (:class:`~proposer_rl.models.Population`), None for a single network.
        action_key, log_prob_key, logits_key, value_key: the names of the entries.
        memory: widths of the head's memory by entry name. The head reads these entries, zeros at
            first, writes them below ``next``, and goes through time if TorchRL's
            ``recurrent_mode()`` is on (:func:`~proposer_rl.models.memory_actor_critic`).

    Attributes:
        normalization: of observations and values; None for none.
    """

    def __init__(
        self,
        head: TensorDictModuleBase,
        encoder: TensorDictModuleBase | None = None,
        *,
        distribution_class: Callable[..., Distribution] = Categorical,
        copies: int | None = None,
        action_key: str = "action",
        log_prob_key: str = "action_log_prob",
        logits_key: str = "logits",
        value_key: str = "state_value",
        memory: Mapping[str, int] | None = None,
    ) -> None:
        super().__init__()
        self.head, self.encoder = head, encoder
        self.distribution_class, self.copies = distribution_class, copies
        self.action_key, self.log_prob_key = action_key, log_prob_key
        self.logits_key, self.value_key = logits_key, value_key
        self.level_keys = list(encoder.in_keys) if encoder is not None else []
        self.context_keys = list(encoder.out_keys) if encoder is not None else []
        self.step_keys = [key for key in head.in_keys if key not in self.context_keys]
        self.in_keys = [*self.level_keys, *self.step_keys]
        self.memory = dict(memory or {})
        self.memory_keys = [("next", key) for key in self.memory]
        self.out_keys = [logits_key, value_key, *self.memory_keys]
        self.normalization: Normalization | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes logits and values for a complete tensordict, [*B] or [*B, T]."""
        inputs = tensordict.select(*self.in_keys)
        if self.encoder is not None:
            inputs = self.encoder(inputs)
        return tensordict.update(self._headed(inputs), keys_to_update=self.out_keys)

    def encode(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the context of levels [*B] (or [K, *B]) for :meth:`decode`."""
        if self.encoder is None:
            return TensorDict({}, tensordict.batch_size, device=tensordict.device)
        return self.encoder(tensordict.select(*self.level_keys)).select(*self.context_keys)

    def decode(self, tensordict: TensorDictBase, context: TensorDictBase) -> TensorDictBase:
        """Writes logits and values of steps [*B, *T], given the context [*B] of their levels.

        Without an encoder the context is empty and every step is computed by itself.
        """
        inputs = tensordict.select(*self.step_keys)
        if self.encoder is not None:
            # Time dimensions become features, so that context and steps have the same batch.
            inputs.batch_size = context.batch_size
            inputs.update(context)
        outputs = self._headed(inputs)
        for key in self.out_keys:
            tensordict.set(key, outputs.get(key))
        return tensordict

    def _headed(self, inputs: TensorDictBase) -> TensorDictBase:
        if self.normalization is None:
            return self.head(inputs)
        outputs = self.head(self.normalization.seen(inputs))
        value = outputs.get(self.value_key)
        return outputs.set(self.value_key, value * self.normalization.unit(value))

    def no_memory(self, tensordict: TensorDictBase) -> TensorDict:
        """Returns the memory before the first step of a batch [*B]: zeros."""
        # TorchRL's collector passes on tensordicts without a device.
        batch, device = tensordict.batch_size, next(self.parameters()).device
        zeros = {key: torch.zeros(*batch, n, device=device) for key, n in self.memory.items()}
        return TensorDict(zeros, batch, device=device)

    def distribution(self, tensordict: TensorDictBase) -> Distribution:
        """Returns the distribution of the action, given a tensordict with logits."""
        return self.distribution_class(logits=tensordict.get(self.logits_key))

    def sampler(self, *, sample: bool = False) -> ProbabilisticTensorDictModule:
        """Returns the module from logits to an action and its probability; see :meth:`actor`."""
        return ProbabilisticTensorDictModule(
            in_keys={"logits": self.logits_key},
            out_keys=[self.action_key],
            distribution_class=self.distribution_class,
            return_log_prob=True,
            log_prob_key=self.log_prob_key,
            default_interaction_type=getattr(
                InteractionType, "RANDOM" if sample else "DETERMINISTIC"
            ),
        )

    def actor(self, *, sample: bool = False) -> ProbabilisticTensorDictSequential:
        """Returns this actor-critic as a TorchRL policy, for collectors and losses elsewhere.

        If the agent has memory, the environment needs its :meth:`primer`. Pass the agent itself as
        the critic of a loss. Give TorchRL's ``GAE`` ``value_network=None``: this policy writes the
        values into a rollout, and ``agent(rollout["next"])`` writes those after each step. As the
        network of ``GAE`` an agent would run under ``vmap``, or carry memory from one episode to
        the next.

        Args:
            sample: whether to draw actions by default, as in ``env.rollout``, instead of taking the
                most probable ones, which do not explore. TorchRL's collectors and
                ``set_exploration_type`` override the default.
        """
        return ProbabilisticTensorDictSequential(self, self.sampler(sample=sample))

    def primer(self) -> TensorDictPrimer:
        """Returns TorchRL's transform that gives an environment the memory of this agent.

        ``TransformedEnv(env, agent.primer())`` carries the memory from step to step, for rollouts
        and collectors elsewhere. An agent without memory needs no primer.
        """
        device = next(self.parameters()).device
        specs = {key: data.Unbounded((width,), device=device) for key, width in self.memory.items()}
        return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)

    def readout(self) -> tuple[ProbabilisticTensorDictSequential, TensorDictModule]:
        """Returns actor and critic that read logits and values from a tensordict.

        For a TorchRL loss whose caller has already run this module, so that actor and critic share
        one forward pass.
        """
        logits = TensorDictModule(nn.Identity(), [self.logits_key], [self.logits_key])
        value = TensorDictModule(nn.Identity(), [self.value_key], [self.value_key])
        return ProbabilisticTensorDictSequential(logits, self.sampler()), value


def one_copy(agent: ActorCritic, number: int) -> ActorCritic:
    """Returns one of an agent's K copies as an agent of one, [1, ...], in shared memory."""
    own: dict[int, Any] = {
        id(p): nn.Parameter(p.detach()[number : number + 1], p.requires_grad)
        for p in agent.parameters()
    }
    own |= {id(buffer): buffer[number : number + 1] for buffer in agent.buffers()}
    alone = deepcopy(agent, own)
    for module in alone.modules():
        if hasattr(module, "copies"):
            module.copies = 1
    return alone


def joint_categorical(logits: Tensor) -> Distribution:
    """Returns P categorical draws as one event: their log-probabilities add up."""
    return Independent(Categorical(logits=logits, validate_args=False), 1)


def categorical(logits: Tensor) -> Distribution:
    """Returns categorical draws, each an event of its own."""
    return Categorical(logits=logits, validate_args=False)


def normal(logits: Tensor) -> Distribution:
    """Returns D normal numbers as one event, from their locations and log-scales [*B, D, 2]."""
    location, log_scale = logits.unbind(-1)
    return Independent(Normal(location, log_scale.exp(), validate_args=False), 1)


def distribution_of(acts: data.TensorSpec) -> Callable[..., Distribution]:
    """Chooses a policy's distribution by the spec of its actions."""
    if isinstance(acts, data.MultiCategorical):
        return joint_categorical
    return categorical if isinstance(acts, data.Categorical) else normal


def draw_at(distribution: Distribution, uniform: Tensor) -> Tensor:
    """Samples by inverting the cumulative distribution function at ``uniform``.

    Torch's distributions take no generator. Here random numbers are data, which can be drawn for a
    whole rollout at once and from one generator per replica.

    Args:
        distribution: categorical, or any other with ``icdf``; possibly ``Independent``.
        uniform: numbers in [0, 1), one for each element of a sample.
    """
    if isinstance(distribution, Independent):
        return draw_at(distribution.base_dist, uniform)
    if isinstance(distribution, Categorical):
        cumulative = distribution.probs.cumsum(-1)
        threshold = uniform.unsqueeze(-1) * cumulative[..., -1:]
        index = (cumulative <= threshold).sum(-1)
        return index.clamp_(max=cumulative.shape[-1] - 1)
    # Uniform numbers include zero, whose quantile may be infinite: take the middle of the interval
    # that zero stands for.
    return distribution.icdf(uniform.clamp(min=torch.finfo(uniform.dtype).eps / 4))


def uniform_noise(
    shape: torch.Size, steps: int, generators: list[torch.Generator] | None, device: torch.device
) -> Tensor:
    """Draws uniform numbers ``[T, *shape]`` for T steps; [:, k] comes from the k-th generator.

    They are drawn on the CPU, so that they are the same for every device, and copied without
    waiting for it. Without generators, torch's default one is used.
    """
    if generators is None:
        drawn = torch.rand(steps, *shape)
    else:
        drawn = torch.stack([torch.rand(steps, *shape[1:], generator=g) for g in generators], 1)
    return (drawn.pin_memory() if device.type == "cuda" else drawn).to(device, non_blocking=True)


def orthogonal_(module: nn.Module, gain: float = 2**0.5) -> None:
    """Initialises every convolution and linear layer orthogonally, biases with zero (in place).

    The default gain keeps the variance of activations through ReLU layers (Saxe et al. 2014).
    """
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Linear):
            nn.init.orthogonal_(layer.weight, gain)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


FARTHEST = 10.0
"""Standard deviations from the mean at which normalised numbers are clipped, as is usual."""

TINY = 1e-8  # added to variances


class RunningMoments(nn.Module):
    """Keeps mean and variance of all numbers so far, separately for each replica.

    TorchRL's ``VecNormV2`` keeps moments for a whole batch of environments or for each of them, but
    not for each replica; and an agent that is evaluated elsewhere does not have the moments of an
    environment's transform. So the moments belong to the agent here, and change only in training.

    Numbers have the shape S. Moments are merged in float64 as in Chan et al. 1983 ("Algorithms for
    computing the sample variance").
    """

    count: Tensor
    mean: Tensor
    variance: Tensor

    def __init__(self, copies: int | None, shape: Sequence[int]) -> None:
        super().__init__()
        rows = [] if copies is None else [copies]
        self._lead = len(rows)
        zeros = torch.zeros(*rows, *shape, dtype=torch.float64)
        self.register_buffer("count", torch.zeros(rows, dtype=torch.float64))
        self.register_buffer("mean", zeros)
        self.register_buffer("variance", torch.ones_like(zeros))

    def update(self, values: Tensor) -> None:
        """Updates the moments by numbers [K, *B, *S], or without replicas [*B, *S]."""
        shape = self.mean.shape[self._lead :]
        rows = values.detach().double().reshape(*self.mean.shape[: self._lead], -1, *shape)
        new = rows.shape[self._lead]
        mean, variance = rows.mean(self._lead), rows.var(self._lead, correction=0)
        before = self.count.reshape(*self.count.shape, *[1] * len(shape))
        share = new / (before + new)
        apart = mean - self.mean
        # At first the share is 1, so the initial variance does not matter.
        self.variance.copy_(
            (1 - share) * self.variance + share * variance + share * (1 - share) * apart.square()
        )
        self.mean.add_(share * apart)
        self.count.add_(new)

    @property
    def deviation(self) -> Tensor:
        """The standard deviation, float32 [K, *S]; 1 before the first numbers."""
        return (self.variance + TINY).sqrt().float()

    def forward(self, values: Tensor) -> Tensor:
        """Standardises numbers [K, *B, *S] and clips them."""
        mean, deviation = (self.along(each, values) for each in (self.mean, self.deviation))
        return ((values - mean.float()) / deviation).clamp(-FARTHEST, FARTHEST)

    def along(self, moments: Tensor, values: Tensor) -> Tensor:
        """Reshapes moments [K, *S] to broadcast against values [K, *B, *S]."""
        between = values.ndim - moments.ndim
        lead = moments.shape[: self._lead]
        return moments.reshape(*lead, *[1] * between, *moments.shape[self._lead :])


class Normalization(nn.Module):
    """Standardises an agent's observations, and keeps the unit of its values.

    Rewards do not change. Instead, the outputs of the critic are multiplied by the standard
    deviation of the discounted return, and its loss is taken in that unit. This equals dividing the
    rewards by it, but values can be read without knowing the unit.

    ``observations`` are the shapes of the normalised entries, by name.
    """

    def __init__(
        self, copies: int | None, observations: Mapping[str, Sequence[int]], *, rewards: bool
    ) -> None:
        super().__init__()
        self.observations = nn.ModuleDict(
            {name: RunningMoments(copies, shape) for name, shape in observations.items()}
        )
        self.returns = RunningMoments(copies, []) if rewards else None

    def seen(self, inputs: TensorDictBase) -> TensorDictBase:
        """Copies a tensordict [K, *B] with its observations normalised."""
        shown = inputs.copy()
        for name, moments in self.observations.items():
            shown.set(name, moments(inputs.get(name)))
        return shown

    def unit(self, values: Tensor) -> Tensor:
        """Returns the unit of values [K, *B, 1], ready to broadcast against them; 1 for none."""
        if self.returns is None:
            return values.new_ones(())
        return self.returns.along(self.returns.deviation, values)

    def update_observations(self, observed: TensorDictBase) -> None:
        """Updates the moments by observations [K, *B]."""
        for name, moments in self.observations.items():
            assert isinstance(moments, RunningMoments)
            moments.update(observed.get(name))
