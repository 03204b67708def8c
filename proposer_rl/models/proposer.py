"""The Proposer: from the Solver's answers on probe levels to a distribution for every problem."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from proposer_rl.models.actor_critic import ActorCritic, categorical, joint_categorical
from proposer_rl.models.unet import orthogonal_

RATIOS = {"joint": joint_categorical, "per_problem": categorical}


class ProposerNetwork(nn.Module):
    """Probes in, one categorical per problem and a value out (the paper's Proposer, section 4).

    A convolutional encoder reads each probe; the mean over the probes is the context g. The logits
    of problem p come from an MLP, shared by all problems, of g and a Fourier encoding of p: given
    g, the problems are independent. The value is an MLP of g.

    Args:
        probe_channels: channels of a probe, its planes and the Solver's logit map.
        problems: number of problems P.
        choices: number of categories N of each problem.
        context: width of g.
        hidden: width of the MLPs.
        channels: channels of the encoder's convolutions; each but the first halves the resolution.
        bands: frequencies of the problem index's Fourier encoding.
    """

    def __init__(
        self,
        probe_channels: int,
        problems: int,
        choices: int,
        *,
        context: int = 128,
        hidden: int = 128,
        channels: Sequence[int] = (32, 64),
        bands: int = 16,
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for i, (fan_in, fan_out) in enumerate(
            zip([probe_channels, *channels], channels, strict=False)
        ):
            layers += [nn.Conv2d(fan_in, fan_out, 3, stride=2 if i else 1, padding=1), nn.ReLU()]
        self.encoder = nn.Sequential(
            *layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(channels[-1], context)
        )
        self.context_layer = nn.Linear(context, hidden)
        self.index_layer = nn.Linear(2 * bands, hidden, bias=False)
        self.logits = nn.Linear(hidden, choices)
        self.value = nn.Sequential(nn.Linear(context, hidden), nn.Tanh(), nn.Linear(hidden, 1))
        self.context = context
        # Not saved: a function of P and the number of bands.
        self.register_buffer("index", fourier_encoding(problems, bands), persistent=False)
        orthogonal_(self)
        # A nearly uniform first policy: no category is preferred before anything is known.
        orthogonal_(self.logits, 0.01)
        orthogonal_(self.value[-1], 1.0)

    def forward(self, probes: Tensor) -> tuple[Tensor, Tensor]:
        """Map probes [*B, C, channels, H, W] to logits [*B, P, N] and values [*B, 1]."""
        context = self._context(probes)  # [*B, context]
        # The first layer is linear in [g, enc(p)], so g's part is computed once for all problems.
        hidden = self.context_layer(context).unsqueeze(-2) + self.index_layer(self.index)
        return self.logits(torch.tanh(hidden)), self.value(context)

    def _context(self, probes: Tensor) -> Tensor:
        leading = probes.shape[:-4]
        if probes.shape[-4] == 0:  # C = 0: a Proposer that does not see the Solver
            return probes.new_zeros(*leading, self.context)
        features = self.encoder(probes.flatten(0, -4))
        return torch.relu(features.reshape(*leading, -1, self.context).mean(-2))


def fourier_encoding(problems: int, bands: int) -> Tensor:
    """Sines and cosines of the problem index at ``bands`` frequencies, float32 [P, 2 * bands].

    The frequencies run geometrically from half a cycle over all problems to the highest that P
    samples can tell apart, P / 2 cycles.
    """
    position = (torch.arange(problems, dtype=torch.float64) + 0.5) / problems
    cycles = torch.logspace(
        math.log2(0.5), math.log2(max(problems / 2, 0.5)), bands, base=2.0, dtype=torch.float64
    )
    phase = 2 * math.pi * position[:, None] * cycles
    return torch.cat([phase.sin(), phase.cos()], -1).float()


def proposer_actor_critic(
    network: nn.Module, ratio: str = "per_problem", *, probes_key: str = "probes"
) -> ActorCritic:
    """Actor-critic of a network that maps probes to logits [*B, P, N] and a value [*B, 1].

    Args:
        network: such as :class:`ProposerNetwork`.
        ratio: what PPO's probability ratio is taken over: ``"joint"``, one for the P draws
            together, or ``"per_problem"``, one for each draw with the same advantage.
        probes_key: entry of the probes.

    Raises:
        ValueError: for an unknown ratio.
    """
    if ratio not in RATIOS:
        raise ValueError(f"ratio must be one of {sorted(RATIOS)}, got {ratio!r}")
    head = TensorDictModule(network, [probes_key], ["logits", "state_value"])
    return ActorCritic(head, distribution_class=RATIOS[ratio])
