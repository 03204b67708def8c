"""The field's maze as a task: Solvers with memory that see 5x5 cells, and how they are measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from proposer_rl.learning import PPO
from proposer_rl.models import ActorCritic, MapEncoder, Population, memory_actor_critic
from proposer_rl.settings import SolverSettings
from proposer_rl.streams import Streams, each_from
from proposer_rl.task import Place, Score
from proposer_rl.tasks.mazes.checks import check_names, named
from proposer_rl.tasks.mazes.distance import shortest_path_length
from proposer_rl.tasks.mazes.edits import edit_levels
from proposer_rl.tasks.mazes.level_files import chosen_levels, shipped_levels, shipped_sets
from proposer_rl.tasks.mazes.level_scores import SLACK
from proposer_rl.tasks.mazes.levels import planes
from proposer_rl.tasks.mazes.records import level_records, level_statistics
from proposer_rl.tasks.mazes.settings import Channels
from proposer_rl.tasks.view_mazes.board import ViewBoard
from proposer_rl.tasks.view_mazes.distance import fewest_actions, optimal_return
from proposer_rl.tasks.view_mazes.distributions import ViewDistribution, ViewSpace
from proposer_rl.tasks.view_mazes.env import ViewMazeEnv
from proposer_rl.tasks.view_mazes.evaluation import play, visits
from proposer_rl.tasks.view_mazes.level_files import SUFFIXES, read_view_levels
from proposer_rl.tasks.view_mazes.level_scores import score_view_levels
from proposer_rl.tasks.view_mazes.levels import ViewLevel, directed
from proposer_rl.tasks.view_mazes.network import OBSERVED, view_network
from proposer_rl.tasks.view_mazes.settings import (
    DistributionSettings,
    EvaluationSettings,
    SpaceSettings,
    ViewMazeSettings,
    ViewNetworkSettings,
)

SAMPLES = 6  # levels of each distribution that a reader is shown
LOCATING = 4096  # levels by which the target is found among the bins
PROBED = 4  # walls, start, goal, and where the Solver goes
TEXT_KEY = "> v < ^ start and direction, G goal, • the Solver's episode"
KEY = "Blue: start. Orange: goal. Purple: the Solver's first episode there."


class ViewMazeTask:
    """The field's maze, and Solvers with memory; a :class:`~proposer_rl.task.Task`.

    A policy with memory has no exact evaluation: everything that is measured is played.

    Args:
        maze: the inner environment.
        distributions: by name.
        target: the name of the one that the Solver is to master.
        space: the Proposer's bins.
        network: of the Solver.
        encoder_channels: of the convolutions with which a Proposer reads a probe.
        evaluation: measurements.
        solver: the Solver's training.
        place: device, precision and cores.

    Raises:
        ValueError: naming the key, if settings that are each valid do not go together.
    """

    exact_performance = False
    default_levels = "shapes"

    def __init__(
        self,
        *,
        maze: ViewMazeSettings,
        distributions: dict[str, DistributionSettings],
        target: str,
        space: SpaceSettings,
        network: ViewNetworkSettings,
        encoder_channels: Channels,
        evaluation: EvaluationSettings,
        solver: SolverSettings,
        place: Place,
    ) -> None:
        check_names(distributions, target, evaluation.distributions)
        self.maze = maze
        self.batch_size = solver.batch_size
        self.device = torch.device(place.device)
        self.precision = "fp32" if place.precision == "auto" else place.precision
        self._cores = place.cores
        self._solver = solver
        self._network = network
        self._encoder_channels = encoder_channels
        self._evaluation = evaluation
        self._target = target
        self._kinds = {
            name: asdict(distributions[name]) for name in (*evaluation.distributions, target)
        }
        grid = (maze.height, maze.width, self.device)
        self.distributions = {
            name: named(f"distributions.{name}", ViewDistribution, kind, *grid)
            for name, kind in distributions.items()
        }
        self.target = self.distributions[target]
        self.space = named("space", ViewSpace, space, *grid)
        scoring = Streams(evaluation.seed, "scores")
        self.board = ViewBoard(maze, evaluation.named_episodes, scoring, self.device)
        self._measured_on = {
            name: self.evaluation_levels(name) for name in evaluation.distributions
        }
        self.measurements = [
            f"{name}_{kind}" for name in self._measured_on for kind in ("success", "return")
        ]

    @property
    def target_shares(self) -> Tensor:
        """The bins nearest to each of many levels of the target, as shares of the bins: [N]."""
        levels = self.target.sample(LOCATING, Streams(0, "target_shares").generator())
        return self.space.shares(levels)

    @property
    def facts(self) -> dict[str, Any]:
        """See :class:`~proposer_rl.task.Task`."""
        size, evaluation = f"{self.maze.height}×{self.maze.width}", self._evaluation
        kinds = [f"{name.upper()} ({_described(self._kinds[name])})" for name in self._measured_on]
        return {
            "title": f"{size} mazes seen through 5×5 cells",
            "levels": "mazes",
            "distributions": list(self._measured_on),
            "space": {name: list(values) for name, values in self.space.axes.items()},
            "about": {
                "Mazes": f"{size}, at most {self.maze.max_steps} steps, turns included",
                "Measured on": f"{'; '.join(kinds)}; {evaluation.levels} fixed levels each, "
                f"episodes on each: {evaluation.episodes}",
            },
            "key": KEY,
            "text_key": TEXT_KEY,
            "measured": {
                "maze": asdict(self.maze),
                "distributions": self._kinds,
                "target": self._target,
                "levels": [evaluation.levels, evaluation.seed, evaluation.episodes],
            },
            "exact": False,
            "samples": {
                name: self.record(levels[:SAMPLES], None)
                for name, levels in self._measured_on.items()
            },
        }

    def evaluation_levels(self, name: str) -> ViewLevel:
        """The fixed levels of a distribution on which Solvers are measured, [E]."""
        generator = Streams(self._evaluation.seed, "evaluation", name).generator()
        return self.distributions[name].sample(self._evaluation.levels, generator)

    def learner(self, streams: Sequence[Streams]) -> PPO:
        """PPO of K fresh Solvers, whose weights are drawn from the streams."""
        copies = len(streams)
        make = each_from(streams, partial(view_network, self._network))
        population = Population(make, copies, self.precision, self._cores).to(self.device)
        # A placeholder of the right shape; every update sets its own levels.
        level = next(iter(self._measured_on.values()))[:1]
        env = ViewMazeEnv(level.expand(copies, self.batch_size), max_steps=self.maze.max_steps)
        agent = memory_actor_critic(population, OBSERVED, self._network.memory)
        return PPO(env, agent, self._solver.ppo)

    def performance(
        self, agent: ActorCritic, levels: ViewLevel, generator: torch.Generator
    ) -> TensorDictBase:
        """Mean return and success of K Solvers over episodes on levels [E] or [K, E]."""
        episodes = self._evaluation.episodes
        return play(agent, levels, self.maze.max_steps, episodes, generator)

    def optimal_return(self, levels: ViewLevel) -> Tensor:
        """The largest expected return of any policy on levels [*B], solvable or not: float [*B]."""
        return optimal_return(levels, self.maze.max_steps)

    def edit(
        self, levels: ViewLevel, count: int, generators: Sequence[torch.Generator]
    ) -> ViewLevel:
        """Levels [K, n] after random edits; see :func:`~proposer_rl.tasks.mazes.edits.edit_levels`.

        The direction of the start stays.
        """
        return directed(edit_levels(levels, count, generators), levels.direction)

    def probe(self, agent: ActorCritic, levels: ViewLevel) -> Tensor:
        """Planes of levels [C], and where the most probable actions lead: float [K, C, 4, H, W]."""
        drawn = planes(levels.expand(agent.copies, *levels.batch_size))
        went = visits(agent, levels, self.maze.max_steps)
        return torch.cat([drawn, went.unsqueeze(-3)], -3)

    def probe_encoder(self, features: int) -> MapEncoder:
        """A convolutional network that reads probes."""
        return MapEncoder(PROBED, self._encoder_channels, features)

    def measure(self, agent: ActorCritic) -> TensorDict:
        """Mean success and return on the fixed levels of each distribution measured on, each [K].

        The random numbers of the actions are the same at every measurement.
        """
        results = {
            f"{name}_{kind}": performance[kind].mean(1)
            for name, performance in self.performances(agent).items()
            for kind in ("success", "return")
        }
        return TensorDict(results, [agent.copies])

    def performances(self, agent: ActorCritic) -> dict[str, TensorDictBase]:
        """What was measured, on each of the fixed levels."""
        streams = Streams(self._evaluation.seed, "episodes")
        return {
            name: self.performance(agent, levels, streams.generator(name))
            for name, levels in self._measured_on.items()
        }

    def statistics(self, levels: ViewLevel, rollout: TensorDictBase) -> TensorDict:
        """What the Solvers trained on."""
        actions = fewest_actions(levels)
        solvable = (actions >= 0) & (actions <= self.maze.max_steps)
        return level_statistics(levels, rollout, shortest_path_length(levels), solvable)

    def record(self, levels: ViewLevel, rollout: TensorDictBase | None) -> list[dict[str, Any]]:
        """Drawings of levels [n], with the Solver's first episode there [n, T] and its cells."""
        return list(level_records(levels, rollout))

    def scores(self, agent: ActorCritic, name: str, max_steps: int | None) -> list[Score]:
        """How Solvers do on a distribution's levels, a file's or those of a set that comes along.

        By playing; without a step limit a distribution has that of the task, other levels at least
        twice the fewest actions.
        """
        drawn = {d: partial(self.evaluation_levels, d) for d in self.distributions}
        levels, of_distribution = chosen_levels(
            name,
            drawn,
            SUFFIXES,
            read_view_levels,
            partial(shipped_levels, kind=ViewLevel),
            f"{', '.join(shipped_sets())}, a file that ends in {' or '.join(SUFFIXES)}, "
            f"or a distribution: {', '.join(self.distributions)}",
        )
        limit, slack = self.maze.max_steps, 0 if of_distribution else SLACK
        return score_view_levels(
            agent,
            levels,
            lambda actions: max_steps or max(limit, slack * actions),
            self._evaluation.named_episodes,
            Streams(self._evaluation.seed, "scores"),
            self.device,
        )


def _described(kind: dict[str, Any]) -> str:
    """A distribution's settings in words."""
    if "most" not in kind:
        return str(kind["kind"]).replace("_", " ")
    solvable = ", solvable" if kind["solvable"] else ""
    return f"{kind['fewest']} to {kind['most']} walls anywhere{solvable}"
