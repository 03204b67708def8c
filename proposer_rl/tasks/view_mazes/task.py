"""The partially observable maze as a task: Solvers with memory, measured by episodes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated

import scipy
import torch
from annotated_types import Ge, Le, Len
from torch import Tensor
from torchrl.envs import EnvBase

from proposer_rl.learning import SolverSettings, mean_performance
from proposer_rl.models import ActorCritic, MemoryNetwork
from proposer_rl.settings import settings
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, LevelResult, for_copies
from proposer_rl.tasks.mazes.grid_task import GridTask
from proposer_rl.tasks.mazes.levels import planes
from proposer_rl.tasks.mazes.maze_settings import Channels
from proposer_rl.tasks.view_mazes import view_env
from proposer_rl.tasks.view_mazes.board import ViewBoard
from proposer_rl.tasks.view_mazes.view_distributions import (
    ViewDistribution,
    ViewDistributionSettings,
    ViewSpace,
    ViewSpaceSettings,
)
from proposer_rl.tasks.view_mazes.view_env import ViewMazeEnv, ViewNetworkSettings
from proposer_rl.tasks.view_mazes.view_levels import VIEW_SUFFIXES, ViewLevel, read_view_levels

LOCATING = 4096  # levels by which the target is located among the bins
EPISODES_AT_ONCE = 4096  # that are played together on named levels


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


class ViewMazeTask(GridTask):
    """The partially observable maze, and Solvers with memory.

    A policy with memory has no exact evaluation: everything that is measured is played.

    Args:
        network: of the Solver.
        maze, distributions, target, space, encoder_channels, evaluation, solver, context: as of
            :class:`~proposer_rl.tasks.mazes.grid_task.GridTask`.

    Raises:
        ValueError: naming the key, if settings that are each valid do not go together.
    """

    level = ViewLevel
    suffixes = VIEW_SUFFIXES
    read_file = staticmethod(read_view_levels)
    fewest_steps = staticmethod(view_env.fewest_actions)
    probe_planes = 4  # walls, start, goal, and where the Solver goes
    steps_name = "fewest_actions"
    replayed = ("rollouts",)
    drop_finished = True
    observed = view_env.VIEW_ENTRIES
    counting = ", turns included"
    text_key = "> v < ^ start and direction, G goal, • the Solver's episode"

    def __init__(
        self,
        *,
        maze: ViewMazeSettings,
        distributions: dict[str, ViewDistributionSettings],
        target: str,
        space: ViewSpaceSettings,
        network: ViewNetworkSettings,
        encoder_channels: Channels,
        evaluation: ViewEvaluationSettings,
        solver: SolverSettings,
        context: ComputeContext,
    ) -> None:
        self._network, self.memory = network, network.memory
        self._named_episodes = evaluation.named_episodes
        self._draws = Streams(evaluation.seed, "scores")  # of named levels
        super().__init__(
            maze, distributions, target, space, encoder_channels, evaluation, solver, context
        )
        self.title = f"{maze.height}×{maze.width} mazes seen through 5×5 cells"
        self.board = ViewBoard(self, self._named_episodes, self._draws)

    def make_distribution(
        self, settings: ViewDistributionSettings, height: int, width: int
    ) -> ViewDistribution:
        """Returns the levels of a distribution's settings on a grid."""
        return ViewDistribution(settings, height, width, self.device)

    def make_space(self, settings: ViewSpaceSettings) -> ViewSpace:
        """Returns the Proposer's bins."""
        return ViewSpace(settings, *self.grid, self.device)

    @property
    def target_shares(self) -> Tensor:
        """Returns the share of the target's levels that is nearest to each bin: float [N]."""
        levels = self.target.sample(LOCATING, Streams(0, "target_shares").generator())
        shares: Tensor = self.space.shares(levels)
        return shares

    def environment(self, levels: ViewLevel) -> EnvBase:
        """Returns an environment of mazes."""
        return ViewMazeEnv(levels, max_steps=self.maze.max_steps)

    def network(self) -> MemoryNetwork:
        """Returns the network of one Solver."""
        return view_env.view_network(self._network)

    def optimal_return(self, levels: ViewLevel) -> Tensor:
        """Returns the largest expected return of any policy on levels [*B]: float [*B]."""
        return view_env.optimal_view_return(levels, self.maze.max_steps)

    def probe(self, agent: ActorCritic, levels: ViewLevel) -> Tensor:
        """Returns planes of levels [C] with the K Solvers' visits: float [K, C, 4, H, W]."""
        drawn = planes(for_copies(agent, levels))
        went = view_env.visits(agent, levels, self.maze.max_steps)
        return torch.cat([drawn, went.unsqueeze(-3)], -3)

    def at_once(self, cells: int) -> int:
        """Returns how many levels are evaluated together."""
        return EPISODES_AT_ONCE // self._named_episodes

    def results_on(
        self,
        agent: ActorCritic,
        levels: ViewLevel,
        about: Mapping[str, Mapping[str, int]],
        max_steps: int,
    ) -> Iterator[LevelResult]:
        """Yields what K Solvers reach in episodes on levels [n] of any one size.

        ``success``, the share of episodes that reached the goal, with the bounds of its 95 %
        interval (Wilson 1927), ``success_low`` and ``success_high``, and ``return``, the mean.
        """
        episodes, generator = self._named_episodes, self._draws.generator(next(iter(about)))
        copies = for_copies(agent, levels)
        performance = mean_performance(
            agent,
            partial(ViewMazeEnv, max_steps=max_steps),
            copies,
            generator,
            max_steps=max_steps,
            episodes=episodes,
            drop_finished=self.drop_finished,
        ).cpu()
        for i, (name, known) in enumerate(about.items()):
            for k in range(len(copies)):
                reached = round(float(performance["success"][k, i]) * episodes)
                interval = scipy.stats.binomtest(reached, episodes).proportion_ci(method="wilson")
                results = {
                    "success": reached / episodes,
                    "success_low": float(interval.low),
                    "success_high": float(interval.high),
                    "return": float(performance["return"][k, i]),
                }
                yield LevelResult(name, k, known, results)
