"""An environment of Gymnasium as a task: Solvers, levels and measurements of one configuration."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cached_property, partial
from typing import Annotated, Any

import gymnasium
import torch
from annotated_types import Ge, Gt
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from proposer_rl.extras import install_command
from proposer_rl.learning import PPO, first_episode_return, first_episode_success
from proposer_rl.models import ActorCritic, Population, categorical, normal
from proposer_rl.runs.pictures import png
from proposer_rl.settings import SolverSettings
from proposer_rl.streams import Streams, each_from
from proposer_rl.task import Place
from proposer_rl.tasks.gymnasium.env import GymnasiumEnv, Vectorization, plays
from proposer_rl.tasks.gymnasium.evaluation import EpisodeEvaluator, answers
from proposer_rl.tasks.gymnasium.levels import SEED, ParameterSpace, space_bins, target_bins
from proposer_rl.tasks.gymnasium.networks import Acts, SolverNetwork, actions, checked_spaces
from proposer_rl.tasks.gymnasium.pictures import KEY, NO_FRAMES, Camera
from proposer_rl.tasks.gymnasium.player import (
    LevelPlayer,
    MakeEnvironment,
    Play,
    RefusedLevelError,
    imported,
)
from proposer_rl.tasks.gymnasium.settings import (
    EvaluationSettings,
    NetworkSettings,
    ParameterSettings,
    SuccessSettings,
)
from proposer_rl.tasks.gymnasium.success import success_rule

SAMPLES = 6  # levels of each distribution that a reader is shown
CPU = torch.device("cpu")
KINDS = ("success", "return")

# Columns of the table of training, where parameters have one each, too; beside PPO's ``loss_...``.
OF_PPO = {"entropy", "kl_approx", "clip_fraction", "explained_variance", "grad_norm"}
RESERVED = {SEED, "updates", "train_success", "train_return", *OF_PPO}


class GymnasiumTask:
    """An environment of Gymnasium some of whose numbers make a level; a Task.

    The contract is :class:`~proposer_rl.task.Task`. Environments are stepped by Gymnasium's vector
    environments, Solvers are small networks: both are on the CPU, whatever the place says.

    Args:
        env_id: as :func:`gymnasium.make` takes it; ``module:name`` imports the module first.
        arguments: of the environment's constructor.
        wrappers: dotted names of functions or classes that are put around each environment, the
            innermost first.
        max_steps: after which an episode is truncated; None for the environment's own limit.
        parameters: what differs between levels, by name.
        success: when an episode is one.
        reward_scale: what rewards are multiplied with in training; returns are told without it.
        network: of the Solver.
        evaluation: measurements.
        vectorization: of the environments that Solvers train in: ``"sync"``, or ``"async"`` for a
            process each.
        extra: of this package, that the environment needs; None for none.
        solver: the Solver's training.
        place: precision and cores.

    Raises:
        ValueError: naming the key, if there is no such environment or parameter, it refuses a value
            of a parameter, there is no network for what it shows or takes, or a package is missing.
    """

    exact_performance = False
    device = CPU

    def __init__(
        self,
        *,
        env_id: str,
        arguments: dict[str, Any],
        wrappers: list[str],
        max_steps: Annotated[int, Ge(1)] | None,
        parameters: dict[str, ParameterSettings],
        success: SuccessSettings,
        reward_scale: Annotated[float, Gt(0)],
        network: NetworkSettings,
        evaluation: EvaluationSettings,
        vectorization: Vectorization,
        extra: str | None,
        solver: SolverSettings,
        place: Place,
    ) -> None:
        self.batch_size = solver.batch_size
        self.precision = "fp32" if place.precision == "auto" else place.precision
        self._parameters = parameters
        self._make = MakeEnvironment(env_id, arguments, max_steps, wrappers)
        self._success, self._rule = success, success_rule(success)
        self._reward_scale = reward_scale
        self._network = network
        self._evaluation = evaluation
        self._vectorization = vectorization
        self._solver = solver
        self._cores = place.cores
        self.space, self.target = _spaces(parameters)
        self.distributions = {"target": self.target, "all": self.space}
        self.measurements = [f"{name}_{kind}" for name in self.distributions for kind in KINDS]
        self._measured_on = {
            name: distribution.sample(evaluation.levels, self._stream("levels", name))
            for name, distribution in self.distributions.items()
        }
        with _named(env_id, extra):
            self._seen, self._acts, self._limit = self._tried()
        self._evaluator = EpisodeEvaluator(
            lambda levels: self._env(levels, once=True),
            episodes=evaluation.episodes,
            greedy=evaluation.actions == "most_probable",
            reward_scale=reward_scale,
        )

    @property
    def target_shares(self) -> Tensor:
        """The target as shares of the bins, what lies outside of them in the nearest: float [N]."""
        return self.space.shares(self.target)

    @property
    def facts(self) -> dict[str, Any]:
        """See :class:`~proposer_rl.task.Task`."""
        env_id, evaluation = self._make.env_id, self._evaluation
        target = "; ".join(
            f"{name} {' or '.join(_range(*ends) for ends in zip(*bins, strict=True))}"
            for name, bins in self.target.bins.items()
        )
        return {
            "title": env_id,
            "levels": "levels",
            "distributions": list(self.distributions),
            "space": {name: list(values) for name, values in self.space.axes.items()},
            "about": {
                "Environment": f"{env_id}, at most {self._limit} steps",
                "Target": target,
                "Measured on": f"{evaluation.levels} fixed levels of the target, and as many of "
                f"all bins; {evaluation.episodes} episode(s) on each, with "
                f"{evaluation.actions.replace('_', ' ')} actions",
            },
            "key": KEY if self._camera.works else NO_FRAMES,
            "measured": {
                "environment": [env_id, self._make.arguments, list(self._make.wrappers)],
                "steps": self._limit,
                "parameters": {name: asdict(p) for name, p in self._parameters.items()},
                "success": asdict(self._success),
                "evaluation": asdict(evaluation),
            },
            "exact": False,
            "samples": {
                name: self.record(levels[:SAMPLES], None)
                for name, levels in self._measured_on.items()
            },
        }

    def learner(self, streams: Sequence[Streams]) -> PPO:
        """PPO of K fresh Solvers, whose weights are drawn from the streams."""
        copies = len(streams)
        one = partial(SolverNetwork, self._seen, self._acts, self._network)
        # MLPs as small as these are faster all at once.
        batched = True if len(self._seen.shape) == 1 else None
        network = Population(each_from(streams, one), copies, self.precision, self._cores, batched)
        agent = ActorCritic(
            TensorDictModule(network, ["observation"], ["logits", "state_value"]),
            distribution_class=categorical if isinstance(self._acts, spaces.Discrete) else normal,
            copies=copies,
        )
        # Placeholders of the right shape; every update sets its own levels.
        level = self._measured_on["target"][:1]
        return PPO(self._env(level.expand(copies, self.batch_size)), agent, self._solver.ppo)

    def performance(
        self, agent: ActorCritic, levels: TensorDictBase, generator: torch.Generator
    ) -> TensorDictBase:
        """Mean return and success of K Solvers' episodes on levels [E] or [K, E]."""
        return self._evaluator(agent, _for_copies(agent, levels), generator)

    @torch.no_grad()
    def probe(self, agent: ActorCritic, levels: TensorDictBase) -> Tensor:
        """What the Solvers would do at the beginning of levels [C], float [K, C, D].

        Probabilities of n actions, or the means of continuous ones.
        """
        copies = _for_copies(agent, levels)
        if not copies.batch_size.numel():
            return torch.zeros(*copies.batch_size, actions(self._acts))
        return answers(agent, self._evaluator.first_states(copies))

    def probe_encoder(self, features: int) -> nn.Module:
        """A linear layer that reads probes."""
        return nn.Linear(actions(self._acts), features)

    def measure(self, agent: ActorCritic) -> TensorDict:
        """Mean ``<name>_success`` and ``<name>_return`` on each distribution's levels, each [K]."""
        measured = {
            f"{name}_{kind}": performance[kind].mean(1)
            for name, performance in self.performances(agent).items()
            for kind in KINDS
        }
        return TensorDict(measured, [agent.copies])

    def performances(self, agent: ActorCritic) -> dict[str, TensorDictBase]:
        """The same on each of the levels, with the same random numbers every time."""
        return {
            name: self.performance(agent, levels, self._stream("actions", name))
            for name, levels in self._measured_on.items()
        }

    def statistics(self, levels: TensorDictBase, rollout: TensorDictBase) -> TensorDict:
        """Mean of each parameter, and of the first episodes' success and return, each [K]."""
        means = {name: levels[name].double().mean(-1) for name in self._parameters}
        reached = {
            "train_success": first_episode_success(rollout).float().mean(-1),
            "train_return": first_episode_return(rollout).mean(-1) / self._reward_scale,
        }
        return TensorDict({**means, **reached}, levels.batch_size[:1])

    def record(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[dict[str, Any]]:
        """Frames of levels [n], and of the Solver's first episode there [n, T]; the parameters."""
        pictures = self._camera.pictures(levels, rollout)
        return [
            {
                "picture": png(picture),
                "text": [f"{name} {value:.4g}" for name, value in play.values.items()],
                "level": {**play.values, SEED: play.seed},
            }
            for picture, play in zip(pictures, plays(levels), strict=True)
        ]

    @cached_property
    def _camera(self) -> Camera:
        first = plays(self._measured_on["target"][:1])[0]
        return Camera(self._make, self._parameters, first)

    def _env(self, levels: TensorDictBase, once: bool = False) -> GymnasiumEnv:
        return GymnasiumEnv(
            levels,
            self._make,
            self._parameters,
            success=self._rule,
            reward_scale=self._reward_scale,
            # Of the levels of evaluations a process each would be too many.
            vectorization="sync" if once else self._vectorization,
            once=once,
        )

    def _stream(self, *key: str) -> torch.Generator:
        return Streams(self._evaluation.seed, "evaluation").generator(*key)

    def _tried(self) -> tuple[spaces.Box, Acts, int]:
        """What the environment shows and takes, and its time limit.

        Each end of each parameter is tried, the others being as in the target.
        """
        functions: list[tuple[str, str | None]] = [("wrappers", one) for one in self._make.wrappers]
        for name, settings in self._parameters.items():
            if settings.set == "call":
                functions.append((f"parameters.{name}.name", settings.name))
        for key, function in functions:
            try:
                imported(function)
            except ValueError as error:
                raise ValueError(f"{key}: {error}") from error
        target = plays(self._measured_on["target"][:1])[0]
        try:
            player = LevelPlayer(self._make, self._parameters, target)
        except RefusedLevelError as error:
            raise ValueError(f"arguments and parameters: {error}") from error
        shown = player.observation_space, player.action_space
        for name, bins in self.space.bins.items():
            for value in (bins.low[0].item(), bins.high[-1].item()):
                player.play = Play({**target.values, name: value}, target.seed)
                player.reset()
                now = player.observation_space, player.action_space
                if now != shown:
                    raise ValueError(
                        f"parameters.{name}: all levels must show and take the same, but {value:g} "
                        f"changes {shown} to {now}"
                    )
        limit = self._make.max_steps or (player.spec and player.spec.max_episode_steps)
        if not limit:
            raise ValueError("max_steps: missing: the environment has no time limit of its own")
        player.close()
        return *checked_spaces(player.observation_space, player.action_space), limit


def _spaces(
    parameters: Mapping[str, ParameterSettings],
) -> tuple[ParameterSpace, ParameterSpace]:
    """The Proposer's space and the target."""
    if not parameters:
        raise ValueError("parameters: at least one: what differs between levels")
    bins, target = {}, {}
    for name, settings in parameters.items():
        try:
            if name in RESERVED or name.startswith("loss_"):
                raise ValueError("is a column of what is told of training; choose another name")
            if not re.fullmatch(r"\w[\w .-]*", name):
                raise ValueError("must be a name of letters, digits, spaces, dots and dashes")
            bins[name], target[name] = space_bins(settings), target_bins(settings)
        except ValueError as error:
            raise ValueError(f"parameters.{name}: {error}") from error
    return ParameterSpace(bins), ParameterSpace(target)


@contextmanager
def _named(env_id: str, extra: str | None) -> Iterator[None]:
    """Tell in one line what is wrong with an environment that cannot be made."""
    try:
        yield
    except (ImportError, gymnasium.error.DependencyNotInstalled) as error:
        how = f"install it with: {install_command(extra)}" if extra else "install it"
        reason = " ".join(str(error).split())
        raise ValueError(f"env_id={env_id}: a package is missing; {how} ({reason})") from error
    except gymnasium.error.Error as error:
        raise ValueError(f"env_id={env_id}: {error}") from error
    except RefusedLevelError as error:
        raise ValueError(f"parameters: {error}") from error


def _for_copies(agent: ActorCritic, levels: TensorDictBase) -> TensorDictBase:
    return levels.expand(agent.copies, levels.batch_size[-1])


def _range(low: Tensor, high: Tensor) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
