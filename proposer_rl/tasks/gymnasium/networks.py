"""The Solver's network, from what an environment shows and takes."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn
from torchrl.modules import MLP

from proposer_rl.models import orthogonal_
from proposer_rl.models.stacked import StackedLinear
from proposer_rl.tasks.gymnasium.settings import NetworkSettings

Acts = spaces.Discrete | spaces.Box

SMALL_MAP = 8  # pixels along its shorter side at most: no more is halved
FIRST_LOG_SCALE = -0.5  # of the policy over continuous actions
POLICY_GAIN = 0.01  # of the policy's last layer: the first policy is nearly uniform


class SolverNetwork(nn.Module):
    """Policy and critic: two MLPs, after convolutions that they share where images are seen.

    Args:
        seen: a box of numbers [D], or of images [H, W, C].
        acts: one of n actions, or a box [D]: its policy is normal, with a scale that is learnt and
            does not depend on what is seen.
        settings: widths, and the observations' scale.
    """

    def __init__(self, seen: spaces.Box, acts: Acts, settings: NetworkSettings) -> None:
        super().__init__()
        self._scale = settings.scale or (1 / 255 if seen.dtype == np.uint8 else 1.0)
        self._sides = len(seen.shape)
        self.stackable = self._sides == 1
        self.convolutions = nn.Sequential()
        features = seen.shape
        if self._sides == 3:
            self.convolutions = _convolutions(seen.shape[2], min(seen.shape[:2]), settings.channels)
            orthogonal_(self.convolutions)
            features = self.convolutions(torch.zeros(1, seen.shape[2], *seen.shape[:2])).shape
        outputs = actions(acts)
        self.policy = _mlp(features[-1], outputs, settings.hidden, POLICY_GAIN)
        self.critic = _mlp(features[-1], 1, settings.hidden, 1.0)
        self.log_scale = None
        if isinstance(acts, spaces.Box):
            self.log_scale = nn.Parameter(torch.full((outputs,), FIRST_LOG_SCALE))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Of observations [*B, ...] logits [*B, n], or [*B, D, 2], and values [*B, 1].

        Those of continuous actions are locations and log-scales.
        """
        seen = observation.float() * self._scale
        if self._sides == 3:
            batch = seen.shape[:-3]
            seen = self.convolutions(seen.flatten(0, -4).permute(0, 3, 1, 2)).unflatten(0, batch)
        logits, value = self.policy(seen), self.critic(seen)
        if self.log_scale is not None:
            between = [1] * (logits.ndim - self.log_scale.ndim)
            scale = self.log_scale.unflatten(-1, (*between, -1))  # with replicas [K, D]
            logits = torch.stack([logits, scale.expand_as(logits)], -1)
        return logits, value


def checked_spaces(seen: spaces.Space[Any], acts: spaces.Space[Any]) -> tuple[spaces.Box, Acts]:
    """Spaces that there is a network for.

    Raises:
        ValueError: for others, saying what there is one for.
    """
    if not isinstance(seen, spaces.Box) or len(seen.shape) not in (1, 3):
        raise ValueError(
            f"observation space {seen}: there is a network for a Box of numbers [D] or of images "
            "[H, W, C]; a wrapper can make it one, such as "
            "task.wrappers=[gymnasium.wrappers.FlattenObservation]"
        )
    if isinstance(acts, spaces.Discrete):
        return seen, acts
    whole = not np.issubdtype(acts.dtype, np.floating)
    if isinstance(acts, spaces.Box) and len(acts.shape) == 1 and not whole:
        return seen, acts
    raise ValueError(
        f"action space {acts}: there is a policy for a Discrete one and for a Box [D] of floats; a "
        "wrapper can make it one"
    )


def actions(acts: Acts) -> int:
    """Number of actions to choose from, or of the parts of a continuous one."""
    return int(acts.n) if isinstance(acts, spaces.Discrete) else acts.shape[0]


def _convolutions(channels: int, side: int, widths: list[int]) -> nn.Sequential:
    """3x3 convolutions; a large map is halved after each of them."""
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
        if side > SMALL_MAP:
            layers.append(nn.MaxPool2d(2))
            side //= 2
        channels = width
    return nn.Sequential(*layers, nn.Flatten())


def _mlp(features: int, outputs: int, hidden: list[int], gain: float) -> MLP:
    mlp = MLP(
        features, outputs, num_cells=hidden, activation_class=nn.Tanh, layer_class=StackedLinear
    )
    orthogonal_(mlp)
    nn.init.orthogonal_(mlp[-1].weight, gain)
    return mlp
