"""Networks of Solvers for any observations and actions: MLPs, CNNs and LSTMs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Gt, Len
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import Categorical, MultiCategorical, TensorSpec
from torchrl.modules import MLP

from proposer_rl.models import MemoryNetwork, orthogonal_
from proposer_rl.models.population import StackedLinear
from proposer_rl.settings import settings
from proposer_rl.tasks.gymnasium.spaces import channels_first

SMALL_MAP = 8  # an image with a shorter side of at most so many pixels is not halved
LARGE_MAP = 36  # from so many pixels on it gets the strides for screens
# Kernels and strides for screens (Mnih et al. 2015, "Human-level control through deep reinforcement
# learning"); further convolutions are like the last.
SCREEN = ((8, 4), (4, 2), (3, 1))
WIDTHS, SCREEN_WIDTHS = (16, 32), (32, 64, 64)
FIRST_LOG_SCALE = -0.5  # of the policy over continuous actions
POLICY_GAIN = 0.01  # of the policy's last layer: the first policy is nearly uniform
NEVER = -1e9  # logit of an action that does not exist


Widths = list[Annotated[int, Ge(1)]]


@settings
class NetworkSettings:
    """Settings of the Solver's network: an MLP for numbers, a CNN for images.

    Attributes:
        hidden: widths of the hidden layers of policy and critic.
        channels: of the convolutions for images; None to choose them by the images' size.
        scale: factor of observations; None for 1, and 1/255 for bytes.
        image: order of an image's axes; None to tell it by the shape.
        memory: width of an LSTM before the heads, which then have one hidden layer, of the last
            width; None for no memory.
    """

    hidden: Annotated[Widths, Len(1)]
    channels: Widths | None = None
    scale: Annotated[float, Gt(0)] | None = None
    image: Literal["HWC", "CHW"] | None = None
    memory: Annotated[int, Ge(1)] | None = None


class SolverNetwork(nn.Module):
    """Policy and critic: two MLPs, for images after convolutions that they share.

    Args:
        seen: specs of the observations, without a batch: numbers [D] or images of three axes.
        acts: spec of the actions: one of n, one of n for each of several choices, or D numbers
            with a normal policy, whose learnt scale does not depend on the observation.
        settings: widths, and the observations' scale.
    """

    def __init__(
        self, seen: Sequence[TensorSpec], acts: TensorSpec, settings: NetworkSettings
    ) -> None:
        super().__init__()
        self.encoder = Encoder(seen, settings)
        features, actions = self.encoder.features, ActionLogits(acts)
        self.policy = _mlp(features, actions.numbers, settings.hidden, POLICY_GAIN)
        self.critic = _mlp(features, 1, settings.hidden, 1.0)
        self.actions = actions
        self.stackable = not self.encoder.convolutions

    def forward(self, *observed: Tensor) -> tuple[Tensor, Tensor]:
        """Returns :class:`ActionLogits`' logits and values [*B, 1] of observations [*B, ...]."""
        features = self.encoder(*observed)
        return self.actions(self.policy(features)), self.critic(features)


def solver_network(
    seen: Sequence[TensorSpec], acts: TensorSpec, settings: NetworkSettings
) -> SolverNetwork | MemoryNetwork:
    """Returns a :class:`SolverNetwork`, or with ``memory`` a network with an LSTM."""
    if settings.memory is None:
        return SolverNetwork(seen, acts, settings)
    encoder, actions = Encoder(seen, settings), ActionLogits(acts)
    network = MemoryNetwork(
        encoder,
        encoder.features,
        actions.numbers,
        memory=settings.memory,
        head=settings.hidden[-1],
    )
    network.policy.append(actions)
    return network


class Encoder(nn.Module):
    """Makes F ``features`` of observations: numbers as they are, images by convolutions."""

    def __init__(self, seen: Sequence[TensorSpec], settings: NetworkSettings) -> None:
        super().__init__()
        self._scales = [
            settings.scale or (1 / 255 if spec.dtype == torch.uint8 else 1.0) for spec in seen
        ]
        self.convolutions = nn.ModuleList()
        self._first: list[bool | None] = []  # whether an image's channels are; None for numbers
        self.features = 0
        for spec in seen:
            shape = spec.shape
            first = None
            if len(shape) == 3:
                first = settings.image == "CHW" if settings.image else channels_first(shape)
                height, width, channels = (*shape[1:], shape[0]) if first else shape
                layers = _convolutions(channels, min(height, width), settings.channels)
                orthogonal_(layers)
                self.convolutions.append(layers)
                shape = layers(torch.zeros(1, channels, height, width)).shape[1:]
            self._first.append(first)
            self.features += shape[0]

    def forward(self, *observed: Tensor) -> Tensor:
        """Returns features [*B, F] of observations [*B, ...]."""
        layers, parts = iter(self.convolutions), []
        for seen, scale, first in zip(observed, self._scales, self._first, strict=True):
            part = seen.float() * scale
            if first is not None:
                batch, images = part.shape[:-3], part.flatten(0, -4)
                images = images if first else images.permute(0, 3, 1, 2)
                part = next(layers)(images).unflatten(0, batch)
            parts.append(part)
        return parts[0] if len(parts) == 1 else torch.cat(parts, -1)


class ActionLogits(nn.Module):
    """Makes logits of a policy's outputs [*B, O].

    They are [*B, n] for one of n actions, [*B, D, n] for D choices among at most n each, and
    [*B, D, 2] for D numbers: their locations and log-scales.

    Attributes:
        numbers: count O of the policy's outputs.
    """

    def __init__(self, acts: TensorSpec) -> None:
        super().__init__()
        self._choices: list[int] | None = None
        self.log_scale: nn.Parameter | None = None
        if isinstance(acts, MultiCategorical):  # a subclass of Categorical
            self._choices = acts.nvec.tolist()
            self.numbers = sum(self._choices)
        elif isinstance(acts, Categorical):
            self.numbers = int(acts.n)
        else:
            self.numbers = acts.shape.numel()
            self.log_scale = nn.Parameter(torch.full((self.numbers,), FIRST_LOG_SCALE))

    def forward(self, numbers: Tensor) -> Tensor:
        """Returns the logits of a policy's outputs [*B, O]."""
        if self.log_scale is not None:
            between = [1] * (numbers.ndim - self.log_scale.ndim)
            scale = self.log_scale.unflatten(-1, (*between, -1))  # [K, D] of stacked replicas
            return torch.stack([numbers, scale.expand_as(numbers)], -1)
        if self._choices is None:
            return numbers
        most = max(self._choices)
        parts = numbers.split(self._choices, -1)
        return torch.stack([F.pad(p, (0, most - p.shape[-1]), value=NEVER) for p in parts], -2)


def _convolutions(channels: int, side: int, widths: Sequence[int] | None) -> nn.Sequential:
    """Returns convolutions for images with a shorter side of so many pixels.

    Those of large images are as for screens; others are 3x3, with a stride of 2 until the map is
    small.
    """
    screen = side >= LARGE_MAP
    layers: list[nn.Module] = []
    for index, width in enumerate(widths or (SCREEN_WIDTHS if screen else WIDTHS)):
        if screen:
            kernel, stride = SCREEN[min(index, len(SCREEN) - 1)]
            layers.append(nn.Conv2d(channels, width, kernel, stride))
        else:
            stride = 2 if side > SMALL_MAP else 1
            layers.append(nn.Conv2d(channels, width, 3, stride, padding=1))
            side = -(-side // stride)
        layers.append(nn.ReLU())
        channels = width
    return nn.Sequential(*layers, nn.Flatten())


def _mlp(features: int, outputs: int, hidden: list[int], gain: float) -> MLP:
    mlp = MLP(
        features, outputs, num_cells=hidden, activation_class=nn.Tanh, layer_class=StackedLinear
    )
    orthogonal_(mlp)
    nn.init.orthogonal_(mlp[-1].weight, gain)
    return mlp
