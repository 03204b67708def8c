"""The Proposer's network: from its view of the Solver to a distribution of actions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Distribution

from proposer_rl.models.actor_critic import ActorCritic, orthogonal_


class MapEncoder(nn.Sequential):
    """Encodes probes that are maps by convolutions.

    Args:
        in_channels: channels of a probe, e.g. its planes and the Solver's logit map.
        channels: of the convolutions, at least one; each but the first halves the resolution.
        features: number of features of a probe.
    """

    def __init__(self, in_channels: int, channels: Sequence[int], features: int) -> None:
        layers: list[nn.Module] = []
        for fan_in, fan_out in zip([in_channels, *channels], channels, strict=False):
            stride = 2 if layers else 1
            layers += [nn.Conv2d(fan_in, fan_out, 3, stride, padding=1), nn.ReLU()]
        pooled = [nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(channels[-1], features)]
        super().__init__(*layers, *pooled)

    def forward(self, maps: Tensor) -> Tensor:
        """Returns features [*B, features] of maps [*B, in_channels, H, W]."""
        features = super().forward(maps.flatten(0, -4))
        return features.unflatten(0, maps.shape[:-3])


class ProposerNetwork(nn.Module):
    """Maps observations to the parameters of the action distribution and to a value.

    An encoder reads each probe; the mean over the probes, together with the other observations, is
    the context g (the paper's Proposer, section 4). ``head`` turns g into the policy, an MLP turns
    it into the value. Weights of encoder and value are initialised orthogonally, biases with zero.

    Args:
        head: from contexts [*B, width] to the parameters of the action's distribution; see
            :class:`ProblemHead` and :class:`MixtureHead`.
        encoder: from probes [*B, ...] of any kind to their features [*B, context]: a
            :class:`MapEncoder` for maps, an MLP for vectors.
        context: number of the encoder's features; the context g is ``context + numbers`` wide.
        numbers: how many numbers are observed besides the probes.
        hidden: width of the value's MLP.
    """

    def __init__(
        self,
        head: nn.Module,
        encoder: nn.Module,
        *,
        context: int = 128,
        numbers: int = 0,
        hidden: int = 128,
    ) -> None:
        super().__init__()
        width = context + numbers
        self.encoder = encoder
        self.value = nn.Sequential(nn.Linear(width, hidden), nn.Tanh(), nn.Linear(hidden, 1))
        orthogonal_(self)
        orthogonal_(self.value[-1], 1.0)
        self.head = head

    def forward(self, probes: Tensor, *numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Maps an observation to the distribution's parameters [*B, ...] and values [*B, 1].

        Args:
            probes: float [*B, C, ...].
            numbers: of what else is observed, each [*B, 1].
        """
        features = self.encoder(probes)  # [*B, C, context]
        *batch, probed, width = features.shape
        # Without probes the Proposer does not see the Solver's answers.
        seen = torch.relu(features.mean(-2)) if probed else features.new_zeros(*batch, width)
        context = torch.cat([seen, *numbers], -1)
        return self.head(context), self.value(context)


class ProblemHead(nn.Module):
    """A policy with one categorical per problem (the paper's Proposer, section 4).

    The logits of problem p come from an MLP, shared by all problems, of the context and a Fourier
    encoding of p: given the context, the problems are independent.

    Args:
        width: of the context.
        problems: number of problems P.
        choices: number of categories N of each problem.
        hidden: width of the MLP.
        bands: frequencies of the problem index's Fourier encoding.
    """

    def __init__(
        self, width: int, problems: int, choices: int, *, hidden: int = 128, bands: int = 16
    ) -> None:
        super().__init__()
        self.context_layer = nn.Linear(width, hidden)
        self.index_layer = nn.Linear(2 * bands, hidden, bias=False)
        self.logits = nn.Linear(hidden, choices)
        # Not saved: a function of P and the number of bands.
        self.register_buffer("index", fourier_encoding(problems, bands), persistent=False)
        orthogonal_(self)
        # A nearly uniform first policy: no category is preferred before anything is known.
        orthogonal_(self.logits, 0.01)

    def forward(self, context: Tensor) -> Tensor:
        """Returns logits [*B, P, N] of contexts [*B, width]."""
        # The first layer is linear in [g, enc(p)], so g's part is computed once for all problems.
        hidden = self.context_layer(context).unsqueeze(-2) + self.index_layer(self.index)
        return self.logits(torch.tanh(hidden))


class MixtureHead(nn.Module):
    """A normal policy over mixtures; an MLP gives the location, the scale is learnt.

    Args:
        width: of the context.
        directions: number D of an action's numbers.
        hidden: width of the MLP.
        spread: standard deviation of the first policy, whose location is nearly zero.
    """

    def __init__(
        self, width: int, directions: int, *, hidden: int = 128, spread: float = 1.0
    ) -> None:
        super().__init__()
        self.location = nn.Sequential(
            nn.Linear(width, hidden), nn.Tanh(), nn.Linear(hidden, directions)
        )
        self.log_scale = nn.Parameter(torch.full((directions,), math.log(spread)))
        orthogonal_(self)
        orthogonal_(self.location[-1], 0.01)

    def forward(self, context: Tensor) -> Tensor:
        """Returns location and log-scale [*B, D, 2] of contexts [*B, width]; see :func:`normal`."""
        location = self.location(context)
        return torch.stack([location, self.log_scale.expand_as(location)], -1)


def fourier_encoding(problems: int, bands: int) -> Tensor:
    """Returns sines and cosines of the problem index at several frequencies, [P, 2 * bands].

    The frequencies run geometrically from half a cycle over all problems to the highest that P
    samples can distinguish, P / 2 cycles.
    """
    position = (torch.arange(problems, dtype=torch.float64) + 0.5) / problems
    cycles = torch.logspace(
        math.log2(0.5), math.log2(max(problems / 2, 0.5)), bands, base=2.0, dtype=torch.float64
    )
    phase = 2 * math.pi * position[:, None] * cycles
    return torch.cat([phase.sin(), phase.cos()], -1).float()


def proposer_actor_critic(
    network: nn.Module,
    distribution: Callable[..., Distribution],
    observed: Sequence[str] = ("probes",),
) -> ActorCritic:
    """Makes the actor-critic of a network from observations to parameters and values [*B, 1].

    Args:
        network: such as :class:`ProposerNetwork`.
        distribution: the action's, from ``logits=`` parameters. For a :class:`ProblemHead`,
            ``categorical`` gives PPO one ratio for each problem's draw, ``joint_categorical`` one
            for all of them; for a :class:`MixtureHead`, ``normal``.
        observed: entries that the network is called with, in order.
    """
    head = TensorDictModule(network, list(observed), ["logits", "state_value"])
    return ActorCritic(head, distribution_class=distribution)
