"""The maze task: all that the maze-free training loops need to know of mazes, from settings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Interval, Len
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from proposer_rl.learning.ppo import PPO, PPOSettings
from proposer_rl.learning.rollout import first_episode_success
from proposer_rl.mazes import (
    Level,
    LevelDistribution,
    MazeEnv,
    SpecificationSpace,
    planes,
    shortest_path_length,
)
from proposer_rl.mazes.evaluation import ExactEvaluator, RolloutEvaluator, worst_mean
from proposer_rl.models import ActorCritic, Population, UNet, cell_logits, map_actor_critic
from proposer_rl.settings import settings
from proposer_rl.streams import Streams

ACTIONS = 4
PLANES = 3
RECORDED_LEVELS = 8
WORST = 0.1  # of the levels, in <name>_success_worst10

Mechanism = Literal["uniform", "path_first"]
Fraction = Annotated[float, Interval(ge=0, lt=1)]
PathLength = Annotated[int, Ge(1)]


@settings
class MazeSettings:
    """The inner environment.

    Attributes:
        height, width: the grid, in cells.
        max_steps: steps after which an episode is truncated.
        step_penalty: what every step costs.
        observe_agent: draw the agent on a fourth plane; then every step needs its own forward pass.
    """

    height: Annotated[int, Ge(1)] = 10
    width: Annotated[int, Ge(1)] = 10
    max_steps: Annotated[int, Ge(1)] = 25
    step_penalty: Annotated[float, Ge(0)] = 0.01
    observe_agent: bool = False


@settings
class DistributionSettings:
    """Levels drawn evenly from (obstacle fraction, path length) pairs, by one mechanism."""

    specifications: Annotated[list[tuple[Fraction, PathLength]], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class SpaceSettings:
    """The Proposer's choices: every obstacle fraction with every path length."""

    obstacle_fractions: Annotated[list[Fraction], Len(1)]
    path_lengths: Annotated[list[PathLength], Len(1)]
    mechanism: Mechanism = "uniform"


@settings
class SolverSettings:
    """The Solver's U-Net and how it is trained.

    Attributes:
        channels: of each resolution, finest first.
        groups: of every GroupNorm; divides each of the channels.
        policy_gain, value_gain: gains of the heads' orthogonal initialisation.
        problems: levels P of an update.
        ppo: PPO's numbers.
    """

    channels: Annotated[list[Annotated[int, Ge(1)]], Len(1)]
    groups: Annotated[int, Ge(1)] = 8
    policy_gain: Annotated[float, Ge(0)] = 0.01
    value_gain: Annotated[float, Ge(0)] = 1.0
    problems: Annotated[int, Ge(1)] = 128
    ppo: PPOSettings = PPOSettings()


@settings
class EvaluationSettings:
    """How the Solver is measured, apart from its training.

    Attributes:
        distributions: names of the distributions that are measured on.
        levels: number of levels of each distribution, the same in every run.
        seed: from which they are drawn.
        reward: evaluator of the Proposer's validation levels: exact, or Monte-Carlo episodes.
        episodes: Monte-Carlo episodes per level.
    """

    distributions: Annotated[list[str], Len(1)]
    levels: Annotated[int, Ge(1)] = 512
    seed: Annotated[int, Ge(0)] = 0
    reward: Literal["exact", "rollout"] = "exact"
    episodes: Annotated[int, Ge(1)] = 1


def faster_precision(channels: Sequence[int], device: torch.device) -> str:
    """``"bf16"`` where it was measured to be faster and to learn alike, else ``"fp32"``.

    That is a wide network on a CPU with matrix instructions for it; see docs/benchmark.md.

    Args:
        channels: of the Solver's network.
        device: that it runs on.
    """
    in_hardware = device.type == "cpu" and torch.cpu._is_amx_tile_supported()
    return "bf16" if in_hardware and channels[0] >= 64 else "fp32"


class MazeTask:
    """Solvers, levels and measurements of one maze configuration.

    Args:
        maze: the inner environment.
        distributions: by name.
        target: the name of the one that the Solver is to master.
        space: the Proposer's choices.
        solver: network and training of the Solver.
        evaluation: measurements.
        device: where everything lives.
        precision: ``"fp32"`` or ``"bf16"``, of the Solver's network.
        cores: Solvers of a population computed at once on a CPU; None for all cores.
        graphs: whether a GPU records rollouts, training and evaluations as CUDA graphs.
        network: makes the network of a Solver, from planes [*B, 3, H, W] (4 with
            ``observe_agent``) to logits [*B, 4, H, W] and values [*B, 1, H, W]; None for the U-Net
            of the settings.

    Attributes:
        recipe: makes the same task, or with other arguments a like one; it can be pickled.

    Raises:
        ValueError: if a name is no distribution's, or levels cannot be made as specified.
    """

    def __init__(
        self,
        *,
        maze: MazeSettings,
        distributions: Mapping[str, DistributionSettings],
        target: str,
        space: SpaceSettings,
        solver: SolverSettings,
        evaluation: EvaluationSettings,
        device: torch.device | str = "cpu",
        precision: str = "fp32",
        cores: int | None = None,
        graphs: bool = True,
        network: Callable[[], nn.Module] | None = None,
    ) -> None:
        self.recipe = partial(
            MazeTask,
            maze=maze,
            distributions=distributions,
            target=target,
            space=space,
            solver=solver,
            evaluation=evaluation,
            device=device,
            precision=precision,
            cores=cores,
            graphs=graphs,
            network=network,
        )
        for name in (target, *evaluation.distributions):
            if name not in distributions:
                raise ValueError(f"{name!r} is none of the distributions {sorted(distributions)}")
        self.maze = maze
        self.solver = solver
        self.device = torch.device(device)
        self.precision = precision
        self.cores = cores
        grid = (maze.height, maze.width)
        self.distributions = {
            name: LevelDistribution(d.specifications, d.mechanism, *grid)
            for name, d in distributions.items()
        }
        self.target = self.distributions[target]
        self.space = SpecificationSpace(
            space.obstacle_fractions, space.path_lengths, space.mechanism, *grid
        )
        rules = (maze.max_steps, maze.step_penalty)
        self._network = network or self._unet
        self._sampled = ExactEvaluator(*rules)
        self._greedy = ExactEvaluator(*rules, greedy=True)
        self._reward_evaluator: ExactEvaluator | RolloutEvaluator = (
            self._sampled
            if evaluation.reward == "exact"
            else RolloutEvaluator(*rules, episodes=evaluation.episodes)
        )
        self._rate = self._rated
        self._measure = self._measured
        self._see = self._seen
        self._evaluation = evaluation
        self._measured_on = {
            name: self.evaluation_levels(name) for name in evaluation.distributions
        }

    def evaluation_levels(self, name: str) -> Level:
        """The fixed levels of a distribution on which Solvers are measured, [E]."""
        return self.distributions[name].sample(
            self._evaluation.levels,
            Streams(self._evaluation.seed, "evaluation", name).generator(),
            device=self.device,
        )

    def solvers(self, streams: Sequence[Streams], share: range | None = None) -> PPO:
        """A population with one Solver for each of K streams, and its environment [K, P].

        Args:
            streams: from which the Solvers' weights are drawn.
            share: the Solvers that are computed here; see :class:`Population`.
        """
        copies, problems = len(streams), self.solver.problems
        weights = iter(streams)

        def make() -> nn.Module:
            with next(weights).as_default("weights"):
                return self._network()

        network = Population(make, copies, self.precision, self.cores).to(self.device)
        agent = map_actor_critic(network, per_step=self.maze.observe_agent)
        # Placeholders of the right shape; every update sets its own levels.
        level = self._measured_on[next(iter(self._measured_on))][:1]
        env = MazeEnv(
            level.expand(copies, problems),
            max_steps=self.maze.max_steps,
            step_penalty=self.maze.step_penalty,
            observe_agent=self.maze.observe_agent,
        )
        return PPO(env, agent, self.solver.ppo)

    def _unet(self) -> UNet:
        return UNet(
            in_channels=PLANES + self.maze.observe_agent,
            head_channels=(ACTIONS, 1),
            channels=self.solver.channels,
            groups=self.solver.groups,
            head_gains=(self.solver.policy_gain, self.solver.value_gain),
        )

    def generate(self, choices: Tensor, generators: list[torch.Generator]) -> Level:
        """Levels [K, P] of the Proposer's choices, int64 [K, P]; copy k's from generator k."""
        return self.space.generate(choices, generators, self.device)

    def directions(self, kind: str) -> Tensor:
        """What the numbers of a mixture add to the log-shares of the space, float [D, M * N].

        Args:
            kind: ``"linear"``: more obstacles and longer paths (D = 2). Besides these two,
                ``"target"``: a number that at 1 makes the target's specifications half of an
                otherwise even mixture, or a little more (D = 3); ``"quadratic"``: their squares and
                product, so that a mixture can favour the middle (D = 5). ``"all"``: every
                specification by itself (D = M * N).

        Raises:
            ValueError: for ``"target"``, if the space has none or nothing but the target's.
        """
        if kind == "all":
            return torch.eye(self.space.size)
        x, y = self.space.coordinates.unbind(-1)
        if kind == "linear":
            return torch.stack([x, y])
        if kind == "quadratic":
            return torch.stack([x, y, x.square(), y.square(), x * y])
        wanted = torch.tensor([s in self.target.specifications for s in self.space.specifications])
        count = int(wanted.sum())
        if count in (0, self.space.size):
            raise ValueError(
                f"proposer.directions=target: {count} of the space's {self.space.size} "
                "specifications are the target's; some must be, and some not"
            )
        return torch.stack([x, y, wanted * math.log(self.space.size / count)])

    def sample_target(self, count: int, generator: torch.Generator) -> Level:
        """Levels [count] of the target distribution."""
        return self.target.sample(count, generator, self.device)

    def sample_space(self, count: int, generator: torch.Generator) -> Level:
        """Levels [count], evenly from the Proposer's space."""
        return self.space.sample(count, generator, self.device)

    def evaluate(
        self, solver: ActorCritic, levels: Level, generator: torch.Generator
    ) -> TensorDictBase:
        """Return and success of K Solvers on levels [E], [K, E], as the reward counts them."""
        if isinstance(self._reward_evaluator, RolloutEvaluator):
            return self._reward_evaluator(*_with_logits(solver, levels), generator)
        return self._rate(levels.to_tensordict(), solver)

    def probe(self, solver: ActorCritic, levels: Level) -> Tensor:
        """Planes and the Solvers' logit maps of levels [C]: float [K, C, 3 + A, H, W]."""
        return self._see(levels.to_tensordict(), solver)["probes"]

    probe_channels = PLANES + ACTIONS
    """Channels of a probe."""

    def measure(self, solver: ActorCritic) -> TensorDict:
        """Exact means over the fixed levels of each distribution measured on, each [K].

        Entries, by the distribution's name: ``<name>_success``, ``<name>_return`` of the sampled
        policy and ``<name>_greedy_success``, ``<name>_greedy_return`` of the greedy one; and
        ``<name>_success_worst10``, the sampled policy's success over the tenth of the levels on
        which it is lowest.
        """
        results: dict[str, Tensor] = {}
        for name, levels in self._measured_on.items():
            for key, value in self._measure(levels.to_tensordict(), solver).items():
                results[f"{name}_{key}"] = value
        return TensorDict(results, [solver.copies])

    def _rated(self, levels: TensorDictBase, solver: ActorCritic) -> TensorDict:
        return self._sampled(*_with_logits(solver, Level.from_tensordict(levels)))

    def _seen(self, levels: TensorDictBase, solver: ActorCritic) -> TensorDict:
        copies, logits = _with_logits(solver, Level.from_tensordict(levels))
        return TensorDict({"probes": torch.cat([planes(copies), logits], -3)})

    def _measured(self, levels: TensorDictBase, solver: ActorCritic) -> TensorDict:
        copies, logits = _with_logits(solver, Level.from_tensordict(levels))
        results: dict[str, Tensor] = {}
        for policy, evaluator in (("", self._sampled), ("greedy_", self._greedy)):
            measured = evaluator(copies, logits)
            for key, value in measured.items():
                results[f"{policy}{key}"] = value.mean(1)
            if not policy:
                results["success_worst10"] = worst_mean(measured["success"], WORST)
        return TensorDict(results, [solver.copies])

    def statistics(self, levels: Level, rollout: TensorDictBase) -> TensorDict:
        """What the Solvers trained on and how they fared there, each [K] from [K, P]."""
        lengths = shortest_path_length(levels).float()
        return TensorDict(
            {
                "obstacle_fraction": levels.walls.float().mean((-3, -2, -1)),
                "path_length": lengths.mean(-1),
                "path_length_sd": lengths.std(-1, correction=0),
                "train_success": first_episode_success(rollout).float().mean(-1),
            },
            levels.batch_size[:1],
        )

    def records(self, levels: Level, rollout: TensorDictBase) -> list[list[dict[str, Any]]]:
        """The first levels of each copy's batch and the Solver's first episode there, for JSON."""
        return [
            [
                {
                    "level": levels[copy, problem].to_text().splitlines(),
                    "path": _first_episode(rollout[copy, problem]),
                }
                for problem in range(min(RECORDED_LEVELS, levels.batch_size[1]))
            ]
            for copy in range(levels.batch_size[0])
        ]


def _with_logits(solver: ActorCritic, levels: Level) -> tuple[Level, Tensor]:
    """Levels [E] once for each of K Solvers, [K, E], with the logits of every cell."""
    copies = levels.expand(solver.copies, *levels.batch_size)
    return copies, cell_logits(solver, planes(copies))


def _first_episode(steps: TensorDictBase) -> list[list[int]]:
    """Cells (row, column) that the agent was in, from the start to the end of its episode [T]."""
    ended = steps["next", "done"].squeeze(-1).tolist()
    count = ended.index(True) + 1 if True in ended else len(ended)
    cells = steps["agent"][:1].tolist() + steps["next", "agent"][:count].tolist()
    return cells
