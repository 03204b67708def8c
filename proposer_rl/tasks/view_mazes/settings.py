"""The settings of the partially observable maze."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, Len

from proposer_rl.settings import BY_KIND, settings

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


DistributionSettings = Annotated[ScatteredSettings | PerfectSettings | RoomsSettings, BY_KIND]


@settings
class SpaceSettings:
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
class EvaluationSettings:
    """How the Solver is measured, apart from its training; always by playing.

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
