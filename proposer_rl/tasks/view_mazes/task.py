"""Trains Solvers with memory in partially observable mazes, and measures them by episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Any

import scipy
import torch
from annotated_types import Ge, Le, Len
from torch import Tensor
from torchrl.envs import EnvBase

from proposer_rl.learning import SolverSettings, mean_performance
from proposer_rl.models import ActorCritic, MemoryNetwork
from proposer_rl.settings import settings
from proposer_rl.streams import Streams
from proposer_rl.task import CellKind, ComputeContext, for_copies
from proposer_rl.tasks.mazes.grid_task import Drawings, GridTask
from proposer_rl.tasks.mazes.levels import (
    FREE,
    GOAL,
    MOVES,
    WALL,
    cell_index,
    planes,
    shortest_way,
    successors,
)
from proposer_rl.tasks.mazes.task import Channels
from proposer_rl.tasks.view_mazes import view_env
from proposer_rl.tasks.view_mazes.view_env import PENALTY, ViewMazeEnv, ViewNetworkSettings
from proposer_rl.tasks.view_mazes.view_levels import (
    AGENTS,
    AHEAD,
    ViewDistribution,
    ViewDistributionSettings,
    ViewLevel,
    ViewSpace,
    ViewSpaceSettings,
)

LOCATING = 4096  # levels of the target that are counted in bins
EPISODES_AT_ONCE = 4096  # on named levels
SHOWN = 20  # sampled episodes on a board
Node = list[int]  # row, column and direction


@settings
class ViewMazeSettings:
    """Settings of the maze.

    Attributes:
        height, width: of the grid inside of its border, in cells.
        max_steps: step limit of an episode.
    """

    height: Annotated[int, Ge(3), Le(100)] = 13
    width: Annotated[int, Ge(3), Le(100)] = 13
    max_steps: Annotated[int, Ge(1)] = 250


@settings
class ViewEvaluationSettings:
    """Settings of evaluations, which play episodes.

    Attributes:
        distributions: names of the distributions to measure on.
        levels: of each distribution, the same in every run.
        seed: of the levels and of the actions.
        episodes: on each level.
        named_episodes: on each level of a set in ``bin/eval``.
    """

    distributions: Annotated[list[str], Len(1)]
    levels: Annotated[int, Ge(1)] = 256
    seed: Annotated[int, Ge(0)] = 0
    episodes: Annotated[int, Ge(1)] = 1
    named_episodes: Annotated[int, Ge(1)] = 100


class ViewMazeTask(GridTask):
    """Partially observable mazes, which Solvers with memory learn to solve.

    A policy with memory has no exact evaluation; all measurements play episodes.

    Args:
        network: of the Solver.
        maze, distributions, target, space, encoder_channels, evaluation, solver, context: as in
            :class:`~proposer_rl.tasks.mazes.grid_task.GridTask`.

    Raises:
        ValueError: naming the key, if settings contradict each other.
    """

    level = ViewLevel
    fewest_steps = staticmethod(view_env.fewest_actions)
    probe_planes = 4  # walls, start, goal, and the Solver's visits
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
        """Returns the distribution of these settings on a grid."""
        return ViewDistribution(settings, height, width, self.device)

    def make_space(self, settings: ViewSpaceSettings) -> ViewSpace:
        """Returns the Proposer's bins."""
        return ViewSpace(settings, *self.grid, self.device)

    @property
    def target_shares(self) -> Tensor:
        """Returns the share of the target's levels nearest to each bin: float [N]."""
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
        """Returns how many levels to evaluate together."""
        return EPISODES_AT_ONCE // self._named_episodes

    def results_on(
        self, agent: ActorCritic, levels: ViewLevel, names: Sequence[str], max_steps: int
    ) -> Mapping[str, Tensor]:
        """Returns the results of K Solvers in episodes on levels [n] of one size, each [K, n].

        They are ``success``, the share of episodes that reach the goal, the bounds of its 95 %
        interval (Wilson 1927), ``success_low`` and ``success_high``, and ``return``, the mean.
        """
        episodes, generator = self._named_episodes, self._draws.generator(names[0])
        performance = mean_performance(
            agent,
            partial(ViewMazeEnv, max_steps=max_steps),
            for_copies(agent, levels),
            generator,
            max_steps=max_steps,
            episodes=episodes,
            drop_finished=self.drop_finished,
        ).cpu()
        reached = (performance["success"].double() * episodes).round()
        counts = reached.flatten().int().tolist()
        tests = [scipy.stats.binomtest(count, episodes) for count in counts]
        bounds = [test.proportion_ci(method="wilson") for test in tests]
        low, high = torch.tensor(bounds, dtype=torch.float64).T.unflatten(1, reached.shape)
        success = {"success": reached / episodes, "success_low": low, "success_high": high}
        return {**success, "return": performance["return"]}


class ViewBoard(Drawings):
    """Shows episodes in partially observable mazes; a :class:`~proposer_rl.task.Board`.

    An action depends on a Solver's memory and not on the cell alone, so there are no maps.

    Args:
        task: the task of the levels.
        episodes: played on a level to measure a Solver.
        streams: of the actions, the same as in ``bin/eval``.
    """

    kinds = (
        CellKind(FREE, "free"),
        CellKind(WALL, "wall"),
        *(CellKind(mark, "start", once=True) for mark in AGENTS),
        CellKind(GOAL, "goal", once=True),
    )
    actions = ("left", "right", "up")  # two turns, and forward

    def __init__(self, task: GridTask, episodes: int, streams: Streams) -> None:
        super().__init__(task)
        self._episodes, self._streams = episodes, streams

    def examine(
        self, agent: ActorCritic, solver: int, level: ViewLevel, max_steps: int | None
    ) -> dict[str, Any]:
        """Returns a Solver's episodes on a level; see :class:`~proposer_rl.task.Board`.

        ``results`` are means over sampled episodes, those of ``bin/eval`` on a level ``drawn``.
        """
        limit = max_steps or self._task.step_limit(int(view_env.fewest_actions(level)))
        goal, following = level.goal.tolist(), _following(level)
        placed = level.to(self._task.device).expand(self._episodes)
        generator = self._streams.generator("drawn")
        noise = torch.rand(limit, self._episodes, generator=generator).to(self._task.device)
        went, steps = (each[solver] for each in view_env.walks(agent, placed, limit, noise))
        best, number = (each[solver, 0] for each in view_env.walks(agent, placed[:1], limit))
        sampled = [one[: n + 1].tolist() for one, n in zip(went, steps.tolist(), strict=True)]
        reached = [path[-1][:2] == goal for path in sampled]
        moves = [len(path) - 1 for path in sampled]
        returns = [r * (1 - PENALTY / limit * n) for r, n in zip(reached, moves, strict=True)]
        results = {"success": reached, "return": returns, "steps": moves}
        return {
            "results": {name: sum(each) / self._episodes for name, each in results.items()},
            "episodes": self._episodes,
            "maps": {},
            "paths": {
                "solver": best[: int(number) + 1].tolist(),
                "shortest": _shortest(level, following),
                "sampled": sampled[:SHOWN],
            },
            "next": following,
            "goal": goal,
            "max_steps": limit,
            "step_penalty": PENALTY / limit,
            "missed": 0.0,
        }


def _following(level: ViewLevel) -> list[list[int]]:
    """Returns the node after each action, [3][H * W * 4], with four directions for each cell."""
    moved = successors(level).tolist()  # [4][H * W], in the order of MOVES
    ahead = [moved[MOVES.index(step)] for step in AHEAD]
    cells, ways = range(len(moved[0])), range(len(AHEAD))
    turned = [[4 * cell + (way + turn) % 4 for cell in cells for way in ways] for turn in (-1, 1)]
    return [*turned, [4 * ahead[way][cell] + way for cell in cells for way in ways]]


def _shortest(level: ViewLevel, following: list[list[int]]) -> list[Node] | None:
    """Returns the nodes of a path of fewest actions; None if there is none."""
    width = level.walls.shape[1]
    start, goal = (int(cell_index(cell, width)) for cell in (level.start, level.goal))
    way = shortest_way(following, 4 * start + int(level.direction), lambda n: n // 4 == goal)
    return None if way is None else [[*divmod(node // 4, width), node % 4] for node in way]
