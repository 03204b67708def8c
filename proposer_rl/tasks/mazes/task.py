"""Mazes as a task: Solvers, levels and measurements of one configuration."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from proposer_rl.learning import PPO
from proposer_rl.models import (
    ActorCritic,
    MapEncoder,
    Population,
    UNet,
    cell_logits,
    cell_maps,
    map_actor_critic,
)
from proposer_rl.settings import SolverSettings
from proposer_rl.streams import Streams, each_from
from proposer_rl.task import EpisodeLaw, Place, Score
from proposer_rl.tasks.mazes.board import MazeBoard
from proposer_rl.tasks.mazes.checks import (
    check_names,
    check_network,
    check_paths,
    check_size,
    named,
)
from proposer_rl.tasks.mazes.distance import shortest_path_length
from proposer_rl.tasks.mazes.distributions import LevelDistribution, SpecificationSpace
from proposer_rl.tasks.mazes.edits import edit_levels
from proposer_rl.tasks.mazes.env import MazeEnv
from proposer_rl.tasks.mazes.evaluation import (
    ExactEvaluator,
    RolloutEvaluator,
    optimal_return,
    worst_mean,
)
from proposer_rl.tasks.mazes.level_files import (
    RECORD,
    SUFFIXES,
    chosen_levels,
    read_levels,
    shipped_levels,
    shipped_sets,
)
from proposer_rl.tasks.mazes.level_scores import SLACK, score_levels
from proposer_rl.tasks.mazes.levels import Level, planes
from proposer_rl.tasks.mazes.occupancy import episode_law
from proposer_rl.tasks.mazes.records import EPISODE, level_records, level_statistics
from proposer_rl.tasks.mazes.settings import (
    Channels,
    DistributionSettings,
    EvaluationSettings,
    MazeSettings,
    NetworkSettings,
    SpaceSettings,
)

ACTIONS = 4
PLANES = 3
SAMPLES = 6  # levels of each distribution that a reader is shown
WORST = 0.1  # of the levels, in <name>_success_worst10
TEXT_KEY = f"S start, G goal, {EPISODE} the Solver's episode"
_ON_A_GRID = re.compile(r"(.+)@(\d{1,3})x(\d{1,3})")
KEY = "Blue: start. Orange: goal. Purple: the Solver's first episode there."


class MazeTask:
    """Mazes, and a U-Net that learns to solve them; a :class:`~proposer_rl.task.Task`.

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
        make_network: makes the network of a Solver, from planes [*B, 3, H, W] (4 with
            ``observe_agent``) to logits [*B, 4, H, W] and values [*B, 1, H, W]; None for the U-Net
            of the settings.

    Raises:
        ValueError: naming the key, if settings that are each valid do not go together.
    """

    default_levels = "shapes"

    def __init__(
        self,
        *,
        maze: MazeSettings,
        distributions: dict[str, DistributionSettings],
        target: str,
        space: SpaceSettings,
        network: NetworkSettings,
        encoder_channels: Channels,
        evaluation: EvaluationSettings,
        solver: SolverSettings,
        place: Place,
        make_network: Callable[[], nn.Module] | None = None,
    ) -> None:
        check_names(distributions, target, evaluation.distributions)
        if make_network is None:
            check_network(maze, network)
        check_paths(maze, distributions, {target, *evaluation.distributions})
        self.maze = maze
        self.solver = solver
        self.batch_size = solver.batch_size
        self.device = torch.device(place.device)
        self.precision = place.precision
        if place.precision == "auto":
            own = make_network is not None
            self.precision = "fp32" if own else faster_precision(network.channels, self.device)
        self.cores = place.cores
        self._network = network
        self._make_network = make_network or self._unet
        self._encoder_channels = encoder_channels
        self._evaluation = evaluation
        self._target = target
        self._measured = {
            name: asdict(distributions[name]) for name in (*evaluation.distributions, target)
        }
        grid = (maze.height, maze.width, self.device)
        self.distributions = {
            name: named(f"distributions.{name}", LevelDistribution, *asdict(d).values(), *grid)
            for name, d in distributions.items()
        }
        self.target = self.distributions[target]
        self.space = named("space", SpecificationSpace, *asdict(space).values(), *grid)
        rules = (maze.max_steps, maze.step_penalty)
        self._sampled = ExactEvaluator(*rules)
        self._greedy = ExactEvaluator(*rules, greedy=True)
        self._evaluator: ExactEvaluator | RolloutEvaluator = (
            self._sampled
            if evaluation.evaluator == "exact"
            else RolloutEvaluator(*rules, episodes=evaluation.episodes)
        )
        self.board = MazeBoard(maze, self._check_size, self._limit, self.device)
        self.exact_performance = evaluation.evaluator == "exact"
        self._measured_on = {
            name: self.evaluation_levels(name) for name in evaluation.distributions
        }
        kinds = ("success", "return", "success_worst10", "greedy_success", "greedy_return")
        self.measurements = [f"{name}_{kind}" for name in self._measured_on for kind in kinds]

    @property
    def target_shares(self) -> Tensor:
        """The target's specifications, each rounded to the nearest bin, float [N]."""
        nearest = self.space.nearest(self.target.specifications)
        return nearest.bincount(minlength=self.space.size) / len(nearest)

    @property
    def facts(self) -> dict[str, Any]:
        """See :class:`~proposer_rl.task.Task`."""
        size = f"{self.maze.height}×{self.maze.width}"
        measured = asdict(self.maze)
        del measured["observe_agent"]
        return {
            "title": f"{size} mazes",
            "levels": "mazes",
            "distributions": list(self._measured_on),
            "space": {name: list(values) for name, values in self.space.axes.items()},
            "about": {
                "Mazes": f"{size}, at most {self.maze.max_steps} steps",
                "Measured on": f"{'; '.join(map(self._describe, self._measured_on))}; "
                f"{self._evaluation.levels} fixed levels each",
            },
            "key": KEY,
            "text_key": TEXT_KEY,
            "measured": {
                "maze": measured,
                "distributions": self._measured,
                "target": self._target,
                "levels": [self._evaluation.levels, self._evaluation.seed],
            },
            "exact": True,  # whatever the evaluator of the Proposer's reward is
            "samples": {
                name: self.record(levels[:SAMPLES], None)
                for name, levels in self._measured_on.items()
            },
        }

    def evaluation_levels(self, name: str) -> Level:
        """The fixed levels of a distribution on which Solvers are measured, [E]."""
        return self._fixed(name, self.distributions[name])

    def _fixed(self, name: str, distribution: LevelDistribution) -> Level:
        generator = Streams(self._evaluation.seed, "evaluation", name).generator()
        return distribution.sample(self._evaluation.levels, generator)

    def learner(self, streams: Sequence[Streams]) -> PPO:
        """PPO of K fresh Solvers, whose weights are drawn from the streams."""
        copies = len(streams)
        make = each_from(streams, self._make_network)
        network = Population(make, copies, self.precision, self.cores).to(self.device)
        # Placeholders of the right shape; every update sets its own levels.
        level = next(iter(self._measured_on.values()))[:1]
        env = MazeEnv(level.expand(copies, self.batch_size), **self._rules)
        agent = map_actor_critic(network, per_step=self.maze.observe_agent)
        return PPO(env, agent, self.solver.ppo)

    def performance(
        self, agent: ActorCritic, levels: Level, generator: torch.Generator
    ) -> TensorDictBase:
        """Return and success of K Solvers on levels [E] or [K, E], as the settings ask for it."""
        return self._evaluator(*_with_logits(agent, levels), generator)

    def differentiable_performance(self, agent: ActorCritic, levels: Level) -> TensorDictBase:
        """Exact return and success of K Solvers, each on its own levels [K, E], with gradients."""
        logits = cell_logits(agent, planes(levels), gradients=torch.is_grad_enabled())
        return self._sampled.differentiable(levels, logits)

    def optimal_return(self, levels: Level) -> Tensor:
        """The largest expected return of any policy on levels [*B], solvable or not: float [*B]."""
        return optimal_return(levels, self.maze.max_steps, self.maze.step_penalty)

    def episode_law(self, agent: ActorCritic, levels: Level) -> EpisodeLaw:
        """Exactly what K Solvers' episodes can be, each on its own levels [K, E]."""
        logits, values = cell_maps(agent, planes(levels))
        policy = logits.softmax(-3, dtype=torch.float64)
        rules = (self.maze.max_steps, self.maze.step_penalty)
        return episode_law(levels, policy, values.squeeze(-3), *rules)

    def edit(self, levels: Level, count: int, generators: Sequence[torch.Generator]) -> Level:
        """Levels [K, n] after random edits."""
        return edit_levels(levels, count, generators)

    def probe(self, agent: ActorCritic, levels: Level) -> Tensor:
        """Planes and the Solvers' logit maps of levels [C]: float [K, C, 3 + A, H, W]."""
        if not levels.numel():
            shown = planes(levels.expand(agent.copies, 0))
            return shown.new_zeros(*shown.shape[:2], PLANES + ACTIONS, *shown.shape[-2:])
        copies, logits = _with_logits(agent, levels)
        return torch.cat([planes(copies), logits], -3)

    def probe_encoder(self, features: int) -> MapEncoder:
        """A convolutional network that reads probes."""
        return MapEncoder(PLANES + ACTIONS, self._encoder_channels, features)

    def measure(self, agent: ActorCritic) -> TensorDict:
        """Exact means over the fixed levels of each distribution measured on, each [K].

        Entries, by the distribution's name: ``<name>_success``, ``<name>_return`` of the sampled
        policy and ``<name>_greedy_success``, ``<name>_greedy_return`` of the greedy one; and
        ``<name>_success_worst10``, the sampled policy's success over the tenth of the levels on
        which it is lowest.
        """
        results: dict[str, Tensor] = {}
        for name, levels in self._measured_on.items():
            copies, logits = _with_logits(agent, levels)
            sampled, greedy = self._sampled(copies, logits), self._greedy(copies, logits)
            for prefix, measured in ((name, sampled), (f"{name}_greedy", greedy)):
                for kind in ("return", "success"):
                    results[f"{prefix}_{kind}"] = measured[kind].mean(1)
            results[f"{name}_success_worst10"] = worst_mean(sampled["success"], WORST)
        return TensorDict(results, [agent.copies])

    def performances(self, agent: ActorCritic) -> dict[str, TensorDictBase]:
        """The sampled policy's, exact, on the fixed levels of each distribution measured on."""
        return {
            name: self._sampled(*_with_logits(agent, levels))
            for name, levels in self._measured_on.items()
        }

    def statistics(self, levels: Level, rollout: TensorDictBase) -> TensorDict:
        """What the Solvers trained on."""
        length = shortest_path_length(levels)
        solvable = (length >= 0) & (length <= self.maze.max_steps)
        return level_statistics(levels, rollout, length, solvable)

    def record(self, levels: Level, rollout: TensorDictBase | None) -> list[dict[str, Any]]:
        """Drawings of levels [n], with the Solver's first episode there [n, T] and its cells."""
        return list(level_records(levels, rollout))

    def scores(self, agent: ActorCritic, name: str, max_steps: int | None) -> list[Score]:
        """How Solvers do on a distribution's levels, a file's or those of a set that comes along.

        Without a step limit a distribution has that of the task, so that the means are those of its
        measurements, also on another grid (``id@13x13``); other levels at least twice the shortest
        path.
        """
        drawn = {d: partial(self.evaluation_levels, d) for d in self.distributions}
        asked = _ON_A_GRID.fullmatch(name)
        if asked:
            for known, distribution in self.distributions.items():
                if known.casefold() == asked[1].casefold():
                    size = [int(cells) for cells in asked.group(2, 3)]
                    grid = named(f"--levels {name}", distribution.on_grid, *size)
                    # The same levels and names however it was spelt.
                    name = f"{known}@{size[0]}x{size[1]}"
                    drawn[name] = partial(self._fixed, name, grid)
                    break
        there_are = (
            f"{', '.join(shipped_sets())}, a file that ends in {' or '.join(SUFFIXES)}, "
            f"a run's curriculum{RECORD}, or a distribution: {', '.join(self.distributions)}, as "
            f"it is or on another grid as in {self._target}@13x13"
        )
        files = (*SUFFIXES, RECORD)
        levels, of_distribution = chosen_levels(
            name, drawn, files, read_levels, shipped_levels, there_are
        )
        slack = 0 if of_distribution else SLACK
        for named_level in levels.items():
            self._check_size(*named_level)
        return score_levels(
            agent,
            levels,
            lambda length: max_steps or self._limit(length, slack),
            self.maze.step_penalty,
            self.device,
        )

    def _check_size(self, name: str, level: Level) -> None:
        """Refuse a level that the U-Net cannot see; what another network sees, nobody knows."""
        if self._make_network == self._unet:
            check_size(name, level.walls.shape, self._network)

    def _limit(self, length: int, slack: int = SLACK) -> int:
        """The step limit of a level, given the length of its shortest path."""
        return max(self.maze.max_steps, slack * length)

    def _describe(self, name: str) -> str:
        distribution = self.distributions[name]
        pairs = "; ".join(
            f"{fraction:g} obstacles, path of {length}"
            for fraction, length in distribution.specifications[:4]
        )
        return f"{name.upper()} ({pairs}; {distribution.mechanism})"

    @property
    def _rules(self) -> dict[str, Any]:
        rules = asdict(self.maze)
        return {key: rules[key] for key in ("max_steps", "step_penalty", "observe_agent")}

    def _unet(self) -> UNet:
        return UNet(
            in_channels=PLANES + self.maze.observe_agent,
            head_channels=(ACTIONS, 1),
            channels=self._network.channels,
            groups=self._network.groups,
            head_gains=(self._network.policy_gain, self._network.value_gain),
        )


def faster_precision(channels: Sequence[int], device: torch.device) -> str:
    """``"bf16"`` where it was measured to be faster and to learn alike, else ``"fp32"``.

    That is a wide network on a CPU with instructions for it; see docs/benchmark.md.

    Args:
        channels: of the Solver's network.
        device: that it runs on.
    """
    in_hardware = device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()
    return "bf16" if in_hardware and channels[0] >= 64 else "fp32"


def _with_logits(agent: ActorCritic, levels: Level) -> tuple[Level, Tensor]:
    """Levels [E], the same for all K Solvers, or [K, E]; [K, E] with the logits of every cell."""
    copies = levels.expand(agent.copies, levels.batch_size[-1])
    return copies, cell_logits(agent, planes(copies))
