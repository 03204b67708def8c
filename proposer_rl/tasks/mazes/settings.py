"""The settings of the maze task."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Interval, Len

from proposer_rl.settings import settings

Mechanism = Literal["uniform", "path_first"]
Fraction = Annotated[float, Interval(ge=0, lt=1)]
PathLength = Annotated[int, Ge(1)]
Fractions = Fraction | Annotated[list[Fraction], Len(1)]
PathLengths = PathLength | Annotated[list[PathLength], Len(1)]
Channels = Annotated[list[Annotated[int, Ge(1)]], Len(1)]


@settings
class MazeSettings:
    """The inner environment.

    Attributes:
        height, width: the grid, in cells.
        max_steps: steps after which an episode is truncated.
        step_penalty: what every step costs.
        observe_agent: draw the agent on a fourth plane; then every step needs its own forward pass.
    """

    height: Annotated[int, Interval(ge=1, le=1000)] = 10
    width: Annotated[int, Interval(ge=1, le=1000)] = 10
    max_steps: Annotated[int, Ge(1)] = 25
    step_penalty: Annotated[float, Ge(0)] = 0.01
    observe_agent: bool = False


@settings
class DistributionSettings:
    """Levels drawn uniformly from (obstacle fraction, path length) pairs, by one mechanism."""

    specifications: Annotated[list[tuple[Fraction, PathLength]], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class SpaceSettings:
    """The Proposer's bins: every obstacle fraction with every path length."""

    obstacle_fractions: Annotated[list[Fraction], Len(1)]
    path_lengths: Annotated[list[PathLength], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class NetworkSettings:
    """The Solver's U-Net.

    Attributes:
        channels: of each resolution, finest first.
        groups: of every GroupNorm; divides each of the channels.
        policy_gain, value_gain: gains of the heads' orthogonal initialisation.
    """

    channels: Channels
    groups: Annotated[int, Ge(1)] = 8
    policy_gain: Annotated[float, Ge(0)] = 0.01
    value_gain: Annotated[float, Ge(0)] = 1.0


@settings
class EvaluationSettings:
    """How the Solver is measured, apart from its training.

    Attributes:
        distributions: names of the distributions that are measured on.
        levels: number of levels of each distribution, the same in every run.
        seed: from which they are drawn.
        evaluator: of the Proposer's validation levels: exact, or Monte-Carlo episodes.
        episodes: Monte-Carlo episodes per level.
    """

    distributions: Annotated[list[str], Len(1)]
    levels: Annotated[int, Ge(1)] = 512
    seed: Annotated[int, Ge(0)] = 0
    evaluator: Literal["exact", "rollout"] = "exact"
    episodes: Annotated[int, Ge(1)] = 1
