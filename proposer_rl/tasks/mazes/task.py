"""Trains and measures Solvers in mazes that they see as a whole, with exact evaluation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Interval, Len
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from proposer_rl.learning import SolverSettings
from proposer_rl.models import (
    ActorCritic,
    Population,
    UNet,
    cell_logits,
    cell_maps,
    map_actor_critic,
)
from proposer_rl.settings import settings
from proposer_rl.task import CellKind, ComputeContext, for_copies
from proposer_rl.tasks.mazes.drawings import EPISODE
from proposer_rl.tasks.mazes.evaluation import (
    ExactEvaluator,
    RolloutEvaluator,
    expected_visits,
    optimal_return,
    policy_path,
    success_from_cells,
    worst_mean,
)
from proposer_rl.tasks.mazes.generation import LevelDistribution, SpecificationSpace
from proposer_rl.tasks.mazes.grid_task import Drawings, GridTask
from proposer_rl.tasks.mazes.levels import (
    FREE,
    GOAL,
    START,
    WALL,
    Level,
    cell_index,
    cell_plane,
    planes,
    shortest_path_length,
    shortest_way,
    successors,
)
from proposer_rl.tasks.mazes.maze_env import MazeEnv

ACTIONS = 4
PLANES = 3
DIGITS = 4  # of the numbers on a board: what can be seen
WORST = 0.1  # of the levels, in <name>_success_worst10
CELLS_AT_ONCE = 2**17  # in one pass through the network

Mechanism = Literal["uniform", "path_first"]
Fraction = Annotated[float, Interval(ge=0, lt=1)]
PathLength = Annotated[int, Ge(1)]
Fractions = Fraction | Annotated[list[Fraction], Len(1)]
PathLengths = PathLength | Annotated[list[PathLength], Len(1)]
Channels = Annotated[list[Annotated[int, Ge(1)]], Len(1)]


@settings
class MazeSettings:
    """Settings of the maze.

    Attributes:
        height, width: of the grid, in cells.
        max_steps: step limit of an episode.
        step_penalty: cost of a step.
        observe_agent: whether a fourth plane shows the agent. Every step then needs a forward pass
            of its own.
    """

    height: Annotated[int, Interval(ge=1, le=1000)] = 10
    width: Annotated[int, Interval(ge=1, le=1000)] = 10
    max_steps: Annotated[int, Ge(1)] = 25
    step_penalty: Annotated[float, Ge(0)] = 0.01
    observe_agent: bool = False


@settings
class DistributionSettings:
    """Settings of a distribution: pairs of obstacle fraction and path length, drawn uniformly."""

    specifications: Annotated[list[tuple[Fraction, PathLength]], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class SpaceSettings:
    """Settings of the Proposer's bins: every obstacle fraction with every path length."""

    obstacle_fractions: Annotated[list[Fraction], Len(1)]
    path_lengths: Annotated[list[PathLength], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class UNetSettings:
    """Settings of the Solver's U-Net.

    Attributes:
        channels: of each resolution, finest first.
        groups: of every GroupNorm, of which each number of channels is a multiple.
        policy_gain, value_gain: gains of the heads' orthogonal initialisation.
    """

    channels: Channels
    groups: Annotated[int, Ge(1)] = 8
    policy_gain: Annotated[float, Ge(0)] = 0.01
    value_gain: Annotated[float, Ge(0)] = 1.0


@settings
class MazeEvaluationSettings:
    """Settings of evaluations.

    Attributes:
        distributions: names of the distributions to measure on.
        levels: of each distribution, the same in every run.
        seed: of the levels.
        evaluator: of the Proposer's validation levels: ``exact``, or ``rollout`` for episodes.
        episodes: on each level, with ``rollout``.
    """

    distributions: Annotated[list[str], Len(1)]
    levels: Annotated[int, Ge(1)] = 512
    seed: Annotated[int, Ge(0)] = 0
    evaluator: Literal["exact", "rollout"] = "exact"
    episodes: Annotated[int, Ge(1)] = 1


class MazeTask(GridTask):
    """Mazes, which a U-Net learns to solve.

    Args:
        network: of the Solver.
        maze, distributions, target, space, encoder_channels, evaluation, solver, context: as in
            :class:`~proposer_rl.tasks.mazes.grid_task.GridTask`.
        make_network: makes the network of a Solver, from planes [*B, 3, H, W] (4 with
            ``observe_agent``) to logits [*B, 4, H, W] and values [*B, 1, H, W]; None for the U-Net
            of the settings.

    Raises:
        ValueError: naming the key, if settings contradict each other.
    """

    exact_metrics = True  # with either evaluator of validation levels
    fewest_steps = staticmethod(shortest_path_length)
    probe_planes = PLANES + ACTIONS
    steps_name = "path_length"
    text_key = f"S start, G goal, {EPISODE} the Solver's episode"

    def __init__(
        self,
        *,
        maze: MazeSettings,
        distributions: dict[str, DistributionSettings],
        target: str,
        space: SpaceSettings,
        network: UNetSettings,
        encoder_channels: Channels,
        evaluation: MazeEvaluationSettings,
        solver: SolverSettings,
        context: ComputeContext,
        make_network: Callable[[], nn.Module] | None = None,
    ) -> None:
        if make_network is None:
            check_grid("maze", (maze.height, maze.width), network)
            if context.precision == "auto":
                precision = faster_precision(network.channels, torch.device(context.device))
                context = context._replace(precision=precision)
        self._network = network
        self._make_network = make_network
        self.exact_performance = evaluation.evaluator == "exact"
        self.replayed = ("rollouts", "probe", "measure")
        if self.exact_performance:
            self.replayed += ("performance",)
        super().__init__(
            maze, distributions, target, space, encoder_channels, evaluation, solver, context
        )
        self.title = f"{maze.height}×{maze.width} mazes"
        for name in sorted({target, *evaluation.distributions}):
            longest = max(length for _, length in distributions[name].specifications)
            if longest > maze.max_steps:
                raise ValueError(
                    f"maze.max_steps={maze.max_steps} must be at least {longest}, the path length "
                    f"of distributions.{name}, or no episode can reach the goal there"
                )
        self._rules = (maze.max_steps, maze.step_penalty)
        self._sampled = ExactEvaluator(*self._rules)
        self._evaluator: ExactEvaluator | RolloutEvaluator = (
            self._sampled
            if self.exact_performance
            else RolloutEvaluator(*self._rules, episodes=evaluation.episodes)
        )
        self.board = MazeBoard(self)

    def make_distribution(
        self, settings: DistributionSettings, height: int, width: int
    ) -> LevelDistribution:
        """Returns the distribution of these settings on a grid."""
        kind = (settings.specifications, settings.mechanism)
        return LevelDistribution(*kind, height, width, self.device)

    def make_space(self, settings: SpaceSettings) -> SpecificationSpace:
        """Returns the Proposer's bins."""
        axes = (settings.obstacle_fractions, settings.path_lengths)
        return SpecificationSpace(*axes, settings.mechanism, *self.grid, self.device)

    @property
    def target_shares(self) -> Tensor:
        """Returns the share of the target's specifications nearest to each bin: float [N]."""
        nearest = self.space.nearest(self.target.specifications)
        return nearest.bincount(minlength=self.space.size) / len(nearest)

    @property
    def metrics(self) -> list[str]:
        """Returns the names of the results of :meth:`measure`."""
        kinds = ("success", "return", "success_worst10", "greedy_success", "greedy_return")
        return [f"{name}_{kind}" for name in self.evaluated_on for kind in kinds]

    def environment(self, levels: Level) -> EnvBase:
        """Returns an environment of mazes."""
        max_steps, step_penalty = self._rules
        return MazeEnv(
            levels,
            max_steps=max_steps,
            step_penalty=step_penalty,
            observe_agent=self.maze.observe_agent,
        )

    def network(self) -> nn.Module:
        """Returns the network of one Solver."""
        if self._make_network is not None:
            return self._make_network()
        return unet(self._network, PLANES + self.maze.observe_agent)

    def actor_critic(self, population: Population, env: EnvBase) -> ActorCritic:
        """Returns K networks that map a maze to logits and values of its cells."""
        return map_actor_critic(population, per_step=self.maze.observe_agent)

    def performance(
        self, agent: ActorCritic, levels: Level, generator: torch.Generator
    ) -> TensorDictBase:
        """Evaluates K Solvers on levels [E] or [K, E], by the evaluator of the settings."""
        return self._evaluator(*_with_logits(agent, levels), generator)

    def differentiable_performance(self, agent: ActorCritic, levels: Level) -> TensorDictBase:
        """Evaluates K Solvers exactly, each on its own levels [K, E], with gradients."""
        logits = cell_logits(agent, planes(levels), gradients=torch.is_grad_enabled())
        return self._sampled(levels, logits)

    def optimal_return(self, levels: Level) -> Tensor:
        """Returns the largest expected return of any policy on levels [*B]: float [*B]."""
        return optimal_return(levels, *self._rules)

    def probe(self, agent: ActorCritic, levels: Level) -> Tensor:
        """Returns planes and the Solvers' logit maps of levels [C]: float [K, C, 3 + A, H, W]."""
        if not levels.batch_size.numel():
            shown = planes(for_copies(agent, levels))
            return shown.new_zeros(*shown.shape[:2], self.probe_planes, *shown.shape[-2:])
        copies, logits = _with_logits(agent, levels)
        return torch.cat([planes(copies), logits], -3)

    def measure(self, agent: ActorCritic) -> TensorDict:
        """Returns exact means over the evaluation levels of each distribution, each [K].

        Entries, by the distribution's name: ``<name>_success``, ``<name>_return`` of the sampled
        policy and ``<name>_greedy_success``, ``<name>_greedy_return`` of the greedy one; and
        ``<name>_success_worst10``, the sampled policy's success over the tenth of the levels on
        which it is lowest.
        """
        means: dict[str, Tensor] = {}
        for name, levels in self.evaluated_on.items():
            performance = self._exactly(*_with_logits(agent, levels), self.maze.max_steps)
            for kind, values in performance.items():
                means[f"{name}_{kind}"] = values.mean(1)
            means[f"{name}_success_worst10"] = worst_mean(performance["success"], WORST)
        return TensorDict(means, [agent.copies])

    def _exactly(self, levels: Level, logits: Tensor, max_steps: int) -> dict[str, Tensor]:
        """Evaluates the sampled policy, and the greedy one as ``greedy_...``, each [K, n]."""
        penalty = self.maze.step_penalty
        sampled = ExactEvaluator(max_steps, penalty)(levels, logits)
        greedy = ExactEvaluator(max_steps, penalty, greedy=True)(levels, logits)
        return {**sampled, **{f"greedy_{kind}": values for kind, values in greedy.items()}}

    def evaluate(self, agent: ActorCritic) -> dict[str, TensorDictBase]:
        """Returns the sampled policy's exact performance on every evaluation level."""
        return {
            name: self._sampled(*_with_logits(agent, levels))
            for name, levels in self.evaluated_on.items()
        }

    def check_level(self, name: str, level: Level) -> None:
        """Checks that the U-Net can see a level; other networks are not checked."""
        if self._make_network is None:
            check_grid(f"level {name!r}", level.walls.shape, self._network)

    def at_once(self, cells: int) -> int:
        """Returns how many levels to evaluate together, for levels of so many cells."""
        return CELLS_AT_ONCE // cells

    @torch.no_grad()
    def results_on(
        self, agent: ActorCritic, levels: Level, names: Sequence[str], max_steps: int
    ) -> Mapping[str, Tensor]:
        """Returns the exact results of K Solvers on levels [n] of one size, each [K, n].

        They are ``success`` and ``return`` of the sampled policy, and ``greedy_success`` (1 or 0)
        and ``greedy_return`` of the most probable actions.
        """
        return self._exactly(*_with_logits(agent, levels), max_steps)


class MazeBoard(Drawings):
    """Shows Solvers in mazes that they see as a whole; a :class:`~proposer_rl.task.Board`."""

    kinds = (
        CellKind(FREE, "free"),
        CellKind(WALL, "wall"),
        CellKind(START, "start", once=True),
        CellKind(GOAL, "goal", once=True),
    )
    actions = ("up", "down", "left", "right")

    @torch.no_grad()
    def examine(
        self, agent: ActorCritic, solver: int, level: Level, max_steps: int | None
    ) -> dict[str, Any]:
        """Returns the exact behaviour of a Solver on a level; see :class:`~proposer_rl.task.Board`.

        ``results`` are ``success``, ``return`` and the expected ``steps`` of the sampled policy.
        ``maps`` are the critic's values, the probability of success from every cell with the whole
        step limit, and the expected number of steps from there in an episode.
        """
        shortest = shortest_path(level)
        steps, step_penalty = len(shortest or [0]) - 1, self._task.maze.step_penalty
        limit = max_steps or self._task.step_limit(steps)
        level = level.to(self._task.device)
        copies = planes(level.expand(agent.copies, 1))
        logits, values = (each[solver, 0] for each in cell_maps(agent, copies))
        logits, values = logits.float(), values[0].float()
        policy = logits.softmax(0)
        visits = expected_visits(level, policy, limit)
        results = ExactEvaluator(limit, step_penalty)(level, logits)
        goal = cell_plane(level.goal, level.walls.shape).bool()
        maps = {
            "critic's value": (values, level.walls | goal),
            "success from here": (success_from_cells(level, policy, limit), level.walls),
            "expected visits": (visits, level.walls),
        }
        path = policy_path(level, logits, limit).tolist()
        return {
            "results": {
                "success": float(results["success"]),
                "return": float(results["return"]),
                "steps": float(visits.sum()),
            },
            "policy": _numbers(policy, level.walls | goal),
            "maps": {name: _numbers(*values) for name, values in maps.items()},
            "paths": {"solver": _until_it_ends(path, level.goal.tolist()), "shortest": shortest},
            "next": successors(level).tolist(),
            "goal": level.goal.tolist(),
            "max_steps": limit,
            "step_penalty": step_penalty,
            "missed": -step_penalty * limit,
        }


def shortest_path(level: Level) -> list[list[int]] | None:
    """Returns the cells (row, column) of a level's shortest path, from start to goal.

    Of several it is the one whose moves come first in
    :data:`~proposer_rl.tasks.mazes.levels.MOVES`. None if there is no path.
    """
    width = level.walls.shape[1]
    start, goal = (int(cell_index(cell, width)) for cell in (level.start, level.goal))
    path = shortest_way(successors(level).tolist(), start, lambda cell: cell == goal)
    return None if path is None else [list(divmod(cell, width)) for cell in path]


def _until_it_ends(path: list[list[int]], goal: list[int]) -> list[list[int]]:
    """Returns a path up to the goal, or up to the first cell that it enters again."""
    seen: set[tuple[int, ...]] = set()
    for length, cell in enumerate(path, 1):
        if cell == goal or tuple(cell) in seen:
            return path[:length]
        seen.add(tuple(cell))
    return path


def _numbers(values: Tensor, without: Tensor) -> list[list[Any]]:
    """Returns values ``[*A, H, W]`` as lists [H][W][*A], with None in cells of ``without``."""
    rows = values.movedim((-2, -1), (0, 1)).double().round(decimals=DIGITS).tolist()
    return [
        [None if left_out else value for value, left_out in zip(row, line, strict=True)]
        for row, line in zip(rows, without.tolist(), strict=True)
    ]


def _with_logits(agent: ActorCritic, levels: Level) -> tuple[Level, Tensor]:
    """Returns levels [E] or [K, E] as [K, E], and the K Solvers' logits at every cell."""
    copies = for_copies(agent, levels)
    return copies, cell_logits(agent, planes(copies))


def unet(network: UNetSettings, planes: int) -> UNet:
    """Returns the U-Net of one Solver for so many planes."""
    return UNet(
        in_channels=planes,
        head_channels=(ACTIONS, 1),
        channels=network.channels,
        groups=network.groups,
        head_gains=(network.policy_gain, network.value_gain),
    )


def faster_precision(channels: Sequence[int], device: torch.device) -> str:
    """Returns ``"bf16"`` if it was measured to be faster and to learn as well, else ``"fp32"``.

    It was for wide networks on CPUs with instructions for it; see docs/explanation/performance.md.

    Args:
        channels: of the Solver's network.
        device: of the network.
    """
    in_hardware = device.type == "cpu" and torch.cpu._is_avx512_bf16_supported()
    return "bf16" if in_hardware and channels[0] >= 64 else "fp32"


def check_grid(what: str, size: Sequence[int], network: UNetSettings) -> None:
    """Checks that the U-Net does not halve a grid to nothing, or to single numbers.

    GroupNorm would make zeros of those.

    Raises:
        ValueError: if it does.
    """
    height, width = size
    if any(
        (height >> halvings) * (width >> halvings) * channels <= network.groups
        for halvings, channels in enumerate(network.channels)
    ):
        raise ValueError(
            f"{what}: {height}x{width} cells are too few for this Solver: with "
            f"network.channels={network.channels} and network.groups={network.groups} a group of "
            "channels has one number or none left"
        )
