"""The Solver's network: a convolution over the view, the direction, and memory."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from proposer_rl.models import MemoryNetwork
from proposer_rl.tasks.view_mazes.env import FORWARD, GOAL, VIEW, WALL
from proposer_rl.tasks.view_mazes.levels import AHEAD
from proposer_rl.tasks.view_mazes.settings import ViewNetworkSettings

OBSERVED = ("view", "direction")
ACTIONS = FORWARD + 1
SCALE = 10  # that the field divides MiniGrid's numbers by
GREY, GREEN = 5, 1  # MiniGrid's colours of walls and goal


class ViewEncoder(nn.Module):
    """Features of views and directions.

    The convolution sees MiniGrid's numbers of objects and of their colours, a tenth of them, as in
    the field. The third number, a door's state, is zero everywhere and left out.

    Args:
        channels: of the convolution.
        direction: features of the direction.

    Attributes:
        features: number of features.
    """

    def __init__(self, channels: int = 16, direction: int = 5) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(2, channels, 3)
        self.direction = nn.Embedding(len(AHEAD), direction)
        nn.init.orthogonal_(self.direction.weight, 2**0.5)
        self.features = channels * (VIEW - 2) ** 2 + direction

    def codes(self, view: Tensor, direction: Tensor) -> Tensor:
        """Numbers of what is seen, int64 [N], equal where views and directions are."""
        digits = ((view & WALL) >> 1) | ((view & GOAL) >> 2)
        base = 4 ** torch.arange(VIEW**2, device=view.device)
        return (digits.flatten(1) * base).sum(1) * len(AHEAD) + direction

    def forward(self, view: Tensor, direction: Tensor) -> Tensor:
        """Features [N, F] of views uint8 [N, 5, 5] and directions int64 [N]."""
        colour = (view == WALL) * GREY + (view == GOAL) * GREEN
        image = torch.stack([view, colour], 1) / SCALE
        seen = torch.relu(self.convolution(image)).flatten(1)
        return torch.cat([seen, self.direction(direction)], 1)


def view_network(settings: ViewNetworkSettings) -> MemoryNetwork:
    """The network of one Solver."""
    encoder = ViewEncoder(settings.channels, settings.direction)
    return MemoryNetwork(
        encoder, encoder.features, ACTIONS, memory=settings.memory, head=settings.head
    )
