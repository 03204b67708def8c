"""The settings of the partially observable maze, and the network that they make."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from annotated_types import Ge, Le, Len
from torch import Tensor, nn

from proposer_rl.models import MemoryNetwork
from proposer_rl.settings import BY_KIND, settings
from proposer_rl.tasks.view_mazes.view_env import FORWARD, VIEW
from proposer_rl.tasks.view_mazes.view_levels import AHEAD, GOAL_OBJECT, WALL_OBJECT

Walls = Annotated[int, Ge(0)]


@settings
class ViewMazeSettings:
    """The inner environment.

    Attributes:
        height, width: the grid inside of its border, in cells.
        max_steps: steps after which an episode is truncated.
    """

    height: Annotated[int, Ge(2), Le(100)] = 13
    width: Annotated[int, Ge(2), Le(100)] = 13
    max_steps: Annotated[int, Ge(1)] = 250


@settings
class ScatteredSettings:
    """Walls anywhere; each number of them from ``fewest`` to ``most`` is equally likely.

    Attributes:
        solvable: whether levels are drawn again whose goal cannot be reached.
    """

    kind: Literal["scattered"] = "scattered"
    fewest: Walls = 0
    most: Walls = 60
    solvable: bool = False


@settings
class PerfectSettings:
    """Mazes with one way between any two cells."""

    kind: Literal["perfect"] = "perfect"


@settings
class RoomsSettings:
    """Four rooms with a door between any two neighbours."""

    kind: Literal["four_rooms"] = "four_rooms"


ViewDistributionSettings = Annotated[ScatteredSettings | PerfectSettings | RoomsSettings, BY_KIND]


@settings
class ViewSpaceSettings:
    """The Proposer's bins.

    Attributes:
        walls: numbers of walls.
        path_lengths: moves on the shortest path, each with each of the numbers; None for start and
            goal anywhere, as in the field.
    """

    walls: Annotated[list[Walls], Len(1)]
    path_lengths: Annotated[list[Annotated[int, Ge(1)]], Len(1)] | None = None


@settings
class ViewNetworkSettings:
    """The Solver's network.

    Attributes:
        channels: of the convolution.
        direction: features of the direction.
        memory: width of the LSTM.
        head: width of the hidden layer of actor and critic.
    """

    channels: Annotated[int, Ge(1)] = 16
    direction: Annotated[int, Ge(1)] = 5
    memory: Annotated[int, Ge(1)] = 256
    head: Annotated[int, Ge(1)] = 32


@settings
class ViewEvaluationSettings:
    """Settings of how the Solver is measured, apart from its training; always by playing.

    Attributes:
        distributions: names of the distributions that are measured on.
        levels: number of levels of each distribution, the same in every run.
        seed: from which they and the actions' random numbers are drawn.
        episodes: on each level.
        named_episodes: on each level of a named set (``bin/eval``).
    """

    distributions: Annotated[list[str], Len(1)]
    levels: Annotated[int, Ge(1)] = 256
    seed: Annotated[int, Ge(0)] = 0
    episodes: Annotated[int, Ge(1)] = 1
    named_episodes: Annotated[int, Ge(1)] = 100


VIEW_ENTRIES = ("view", "direction")
VIEW_ACTIONS = FORWARD + 1
SCALE = 10  # that the field divides MiniGrid's numbers by
GREY_COLOUR, GREEN_COLOUR = 5, 1  # MiniGrid's colours of walls and goal


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
        """Returns codes int64 [N], equal where both views and directions are equal."""
        digits = ((view & WALL_OBJECT) >> 1) | ((view & GOAL_OBJECT) >> 2)
        base = 4 ** torch.arange(VIEW**2, device=view.device)
        return (digits.flatten(1) * base).sum(1) * len(AHEAD) + direction

    def forward(self, view: Tensor, direction: Tensor) -> Tensor:
        """Returns features [N, F] of views uint8 [N, 5, 5] and directions int64 [N]."""
        colour = (view == WALL_OBJECT) * GREY_COLOUR + (view == GOAL_OBJECT) * GREEN_COLOUR
        image = torch.stack([view, colour], 1) / SCALE
        seen = torch.relu(self.convolution(image)).flatten(1)
        return torch.cat([seen, self.direction(direction)], 1)


def view_network(settings: ViewNetworkSettings) -> MemoryNetwork:
    """Returns the network of one Solver."""
    encoder = ViewEncoder(settings.channels, settings.direction)
    return MemoryNetwork(
        encoder, encoder.features, VIEW_ACTIONS, memory=settings.memory, head=settings.head
    )
