"""An actor-critic in two parts: what is computed once per level, and what once per step."""

from __future__ import annotations

from collections.abc import Callable, Mapping

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
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

from proposer_rl.models.normalization import Normalization


class ActorCritic(TensorDictModuleBase):
    """Writes action logits and a state value; its ``encoder`` part depends on the level alone.

    Called as a module it is an ordinary TorchRL actor-critic: a tensordict with one observation per
    step goes in, logits and value come out. Where the encoder's inputs stay the same throughout a
    rollout, :meth:`encode` runs it once and :meth:`decode` reads the steps off that context, with
    the same numbers and T times less arithmetic.

    Args:
        head: reads the encoder's outputs and the observation of a step, writes ``logits_key`` and
            ``value_key``. With an encoder, every other input may carry time dimensions behind the
            batch ones, [*B, *T, ...], and the outputs then carry them too.
        encoder: reads what is constant within a level; None where nothing is.
        distribution_class: builds the action's distribution from ``logits=``.
        copies: K if parameters and data carry independent replicas as their first dimension
            (:class:`~proposer_rl.models.Population`), None for a single network.
        action_key, log_prob_key, logits_key, value_key: the entries' names.
        memory: of a head that remembers, the widths of its memory by the entries' names: it reads
            them, zeros at first, writes them below ``next``, and goes through time where TorchRL's
            ``recurrent_mode()`` says so (:func:`~proposer_rl.models.memory_actor_critic`).

    Attributes:
        normalization: between what is observed and the head, and of its values; None for none.
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
        self.head = head
        self.encoder = encoder
        self.distribution_class = distribution_class
        self.copies = copies
        self.action_key = action_key
        self.log_prob_key = log_prob_key
        self.logits_key = logits_key
        self.value_key = value_key
        self.level_keys = list(encoder.in_keys) if encoder is not None else []
        self.context_keys = list(encoder.out_keys) if encoder is not None else []
        self.step_keys = [key for key in head.in_keys if key not in self.context_keys]
        self.in_keys = [*self.level_keys, *self.step_keys]
        self.memory = dict(memory or {})
        self.memory_keys = [("next", key) for key in self.memory]
        self.out_keys = [logits_key, value_key, *self.memory_keys]
        self.normalization: Normalization | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes logits and values for a tensordict with everything in it, [*B] or [*B, T]."""
        inputs = tensordict.select(*self.in_keys)
        if self.encoder is not None:
            inputs = self.encoder(inputs)
        return tensordict.update(self._headed(inputs), keys_to_update=self.out_keys)

    def encode(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns the context of levels [*B] (or [K, *B]): what :meth:`decode` needs of them."""
        if self.encoder is None:
            return TensorDict({}, tensordict.batch_size, device=tensordict.device)
        return self.encoder(tensordict.select(*self.level_keys)).select(*self.context_keys)

    def decode(self, tensordict: TensorDictBase, context: TensorDictBase) -> TensorDictBase:
        """Writes logits and values of steps [*B, *T], given their levels' context [*B].

        Without an encoder the context is empty and every step is computed by itself.
        """
        inputs = tensordict.select(*self.step_keys)
        if self.encoder is not None:
            # The time dimensions become features, so that context and steps share their batch.
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
        # TorchRL's collector hands on tensordicts without a device.
        batch, device = tensordict.batch_size, next(self.parameters()).device
        zeros = {key: torch.zeros(*batch, n, device=device) for key, n in self.memory.items()}
        return TensorDict(zeros, batch, device=device)

    def distribution(self, tensordict: TensorDictBase) -> Distribution:
        """Returns the action's distribution, given a tensordict with logits."""
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
        """Returns this actor-critic as a TorchRL policy, for collectors and losses of other code.

        An environment around which an agent with memory acts needs its :meth:`primer`. The critic
        of a loss is the agent itself. TorchRL's ``GAE`` takes ``value_network=None``: the values of
        this policy stand in a rollout, and ``agent(rollout["next"])`` writes those after each step.
        As its network an agent would run under ``vmap``, or remember one episode in the next.

        Args:
            sample: whether actions are drawn where nothing else is said, as in ``env.rollout``;
                otherwise they are the most probable ones there, which explore nothing. TorchRL's
                collectors and ``set_exploration_type`` say for themselves which it is to be.
        """
        return ProbabilisticTensorDictSequential(self, self.sampler(sample=sample))

    def primer(self) -> TensorDictPrimer:
        """Returns TorchRL's transform by which an environment begins its episodes without a memory.

        ``TransformedEnv(env, agent.primer())`` hands the memory on from step to step, for rollouts
        and collectors of other code; an agent without memory needs none.
        """
        device = next(self.parameters()).device
        specs = {key: Unbounded((width,), device=device) for key, width in self.memory.items()}
        return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)

    def readout(self) -> tuple[ProbabilisticTensorDictSequential, TensorDictModule]:
        """Returns actor and critic that take logits and values as they stand in a tensordict.

        For a TorchRL loss whose caller has run this module already, so that actor and critic share
        one forward pass.
        """
        logits = TensorDictModule(nn.Identity(), [self.logits_key], [self.logits_key])
        value = TensorDictModule(nn.Identity(), [self.value_key], [self.value_key])
        return ProbabilisticTensorDictSequential(logits, self.sampler()), value


def joint_categorical(logits: Tensor) -> Distribution:
    """Returns P categorical draws as one event, with the sum of their log-probabilities."""
    return Independent(Categorical(logits=logits, validate_args=False), 1)


def categorical(logits: Tensor) -> Distribution:
    """Returns categorical draws, each an event of its own."""
    return Categorical(logits=logits, validate_args=False)


def normal(logits: Tensor) -> Distribution:
    """Returns D normal numbers as one event, from their locations and log-scales [*B, D, 2]."""
    location, log_scale = logits.unbind(-1)
    return Independent(Normal(location, log_scale.exp(), validate_args=False), 1)


def draw_at(distribution: Distribution, uniform: Tensor) -> Tensor:
    """Samples by inverting the cumulative distribution function at ``uniform``.

    Torch's distributions take no generator. This way the random numbers are data, which can be
    drawn for a whole rollout at once and from one generator per replica.

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
    # Zero is among the uniform numbers, but its quantile may be infinite: the middle of the
    # interval that it stands for is taken instead.
    return distribution.icdf(uniform.clamp(min=torch.finfo(uniform.dtype).eps / 4))


def uniform_noise(
    shape: torch.Size, steps: int, generators: list[torch.Generator] | None, device: torch.device
) -> Tensor:
    """Returns uniform numbers ``[T, *shape]`` for T steps; [:, k] comes from the k-th generator.

    They are drawn on the CPU, so that they are the same for every device, and handed on without
    waiting for it. Without generators all of it comes from torch's default one.
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
