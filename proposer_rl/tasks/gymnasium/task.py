"""Trains and measures Solvers in any Gymnasium environment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from functools import cached_property
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
import torch
from annotated_types import Ge, Le
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from proposer_rl.extras import install_command, where_to_look
from proposer_rl.learning import SolverSettings, in_first_episode
from proposer_rl.runs.records import png
from proposer_rl.settings import settings
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task
from proposer_rl.tasks.gymnasium.batched_env import FLAGS, GymnasiumEnv, Vectorization, plays
from proposer_rl.tasks.gymnasium.environment import SuccessSettings, UnfitEnvironmentError
from proposer_rl.tasks.gymnasium.networks import NetworkSettings, SolverNetwork, solver_network
from proposer_rl.tasks.gymnasium.pictures import FRAMES, NO_FRAMES, Camera
from proposer_rl.tasks.gymnasium.player import (
    GymLevel,
    LevelPlayer,
    MakeEnvironment,
    ParameterSettings,
    WrapperSettings,
    cause,
)
from proposer_rl.tasks.gymnasium.trial import check_environment
from proposer_rl.tasks.parameters import LARGEST_SEED, SEED, ParameterSpace
from proposer_rl.tasks.ranges import spaces


@settings
class EvaluationSettings:
    """Settings of evaluations, which play episodes.

    Attributes:
        levels: of each distribution, the same in every run.
        episodes: played on each level. More than one is of use only with sampled actions: each
            begins with the level's own seed, so that the most probable ones repeat it.
        actions: sampled from the policy, or the most probable ones.
        seed: of the levels and of the actions.
    """

    levels: Annotated[int, Ge(1)]
    episodes: Annotated[int, Ge(1)] = 1
    actions: Literal["sampled", "most_probable"] = "sampled"
    seed: Annotated[int, Ge(0)] = 0


class GymnasiumTask(Task):
    """Any Gymnasium environment, in which settings such as gravity make a level.

    Gymnasium's vector environments step it on the CPU; levels, states and Solvers are on the
    context's device.

    Args:
        env_id: as in :func:`gymnasium.make`; ``module:name`` imports the module first.
        arguments: of the environment's constructor.
        wrappers: dotted names of functions or classes to put around each environment, the innermost
            first; or mappings from such a name to further arguments.
        max_steps: step limit of an episode; None for the environment's own.
        parameters: what differs between levels, by name.
        success: when an episode is a success.
        network: the Solver's network.
        evaluation: how the Solver is measured.
        vectorization: ``"sync"`` steps the environments one after another, ``"async"`` each in a
            process of its own.
        extra: of this package, which the environment needs; None for none.
        solver: the Solver's training.
        context: device, precision and cores.
        train_seeds: count of seeds in training. ``target`` and ``all`` are then measured on other
            seeds, and ``train`` on those of the training. None for any seed in all of them.

    Raises:
        ValueError: naming the key, if the environment cannot be made, a parameter cannot be set,
            no network fits the spaces, or a package is missing.
    """

    episodes_at_once = 64

    def __init__(
        self,
        *,
        env_id: str,
        arguments: dict[str, Any],
        wrappers: list[WrapperSettings],
        max_steps: Annotated[int, Ge(1)] | None,
        parameters: dict[str, ParameterSettings],
        success: SuccessSettings,
        network: NetworkSettings,
        evaluation: EvaluationSettings,
        vectorization: Vectorization,
        extra: str | None,
        solver: SolverSettings,
        context: ComputeContext,
        train_seeds: Annotated[int, Ge(1), Le(LARGEST_SEED - 1)] | None = None,
    ) -> None:
        self._parameters = parameters
        self._make = MakeEnvironment(env_id, arguments, max_steps, wrappers)
        self._success = success
        self._network = network
        self._evaluation = evaluation
        self._vectorization = vectorization
        self._envs: dict[torch.Size, EnvBase] = {}
        train = range(LARGEST_SEED) if train_seeds is None else range(train_seeds)
        space, target = spaces(parameters, seeds=train, device=context.device)
        self._test: Mapping[str, ParameterSpace] = {}
        distributions = {"target": target, "all": space}
        if train_seeds is not None:
            distributions["train"] = space
            test = range(train_seeds, LARGEST_SEED)
            both = spaces(parameters, seeds=test, device=context.device)
            self._test = dict(zip(("all", "target"), both, strict=True))
        if parameters:
            self.edit = space.edit
        super().__init__(
            distributions=distributions,
            target="target",
            space=space,
            solver=solver,
            context=context,
            levels=evaluation.levels,
            seed=evaluation.seed,
            episodes=evaluation.episodes,
            greedy=evaluation.actions == "most_probable",
        )
        self.title = env_id
        first = self.evaluated_on["target"][:1]
        (self._first,) = plays(first, parameters)
        with _named(env_id, extra):
            self.max_steps = check_environment(
                self._make, parameters, space.bins, self._first, success
            )
        self._seen, self._acts = self._specs(first)
        self.observed, self.memory = list(self._seen), network.memory
        # Small MLPs of several Solvers are faster together.
        small = all(spec.ndim == 1 for spec in self._seen.values())
        self.batched = True if small and network.memory is None else None
        self._measured = {
            # Older runs name TorchRL's transforms last, of which there are none.
            "environment": [env_id, arguments, list(wrappers), []],
            "steps": self.max_steps,
            "parameters": {name: one.measured for name, one in parameters.items()},
            "success": asdict(success),
            "evaluation": asdict(evaluation),
            "train_seeds": train_seeds,
        }

    @property
    def target_shares(self) -> Tensor:
        """Returns the target's share in each bin, or nearest to it outside of all: float [N]."""
        shares: Tensor = self.space.shares(self.target)
        return shares

    @property
    def key(self) -> str:  # type: ignore[override]
        """Returns a description of a record's picture."""
        return FRAMES if self._camera.works else NO_FRAMES

    @property
    def about(self) -> dict[str, str]:
        """Returns facts about the task for readers, by their labels."""
        evaluation = self._evaluation
        return {
            "Environment": f"{self.title}, at most {self.max_steps} steps",
            "Target": str(self.target),
            "Measured on": f"{evaluation.levels} fixed levels of the target, and as many of "
            f"all bins; {evaluation.episodes} episode(s) on each, with "
            f"{evaluation.actions.replace('_', ' ')} actions",
        }

    def environment(self, levels: TensorDictBase) -> EnvBase:
        """Returns environments for training."""
        return self._env(levels, vectorization=self._vectorization)

    def evaluation_environment(self, levels: TensorDictBase) -> EnvBase:
        """Returns environments that play each level once, and are reused for a batch shape."""
        shape = levels.batch_size
        if shape not in self._envs:
            self._envs[shape] = self._env(levels, vectorization=self._vectorization, once=True)
        self._envs[shape].set_levels(levels)
        return self._envs[shape]

    def network(self) -> nn.Module:
        """Returns the network of one Solver for the environment's spaces."""
        return solver_network(list(self._seen.values()), self._acts, self._network)

    def evaluation_distribution(self, name: str) -> ParameterSpace:
        """Returns a distribution, with other seeds than the training if it has seeds of its own."""
        return self._test.get(name, self.distributions[name])

    def stream(self, use: str, name: str) -> torch.Generator:
        """Returns the generator of an evaluation's ``"levels"`` or ``"actions"``."""
        return Streams(self._evaluation.seed, "evaluation").generator(use, name)

    def record(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[dict[str, Any]]:
        """Returns pictures of levels [n] and first episodes there [n, T], and the parameters."""
        shown = zip(self.pictures(levels, rollout), self._plays(levels), strict=True)
        return [
            {"picture": png(p), "text": one.lines, "level": {**one.values, SEED: one.seed}}
            for p, one in shown
        ]

    def pictures(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[NDArray[np.uint8]]:
        """Draws frames of levels [n], and of the Solver's first episode there [n, T]."""
        taken: list[Any] = [None] * len(levels)
        if rollout is not None:
            pairs = zip(rollout["action"], in_first_episode(rollout), strict=True)
            taken = [actions[steps] for actions, steps in pairs]
        return list(map(self._camera.picture, self._plays(levels), taken))

    def own_spaces(self) -> tuple[gymnasium.Space[Any], gymnasium.Space[Any]]:
        """Returns the spaces of observations and actions of one environment with its wrappers."""
        env = LevelPlayer(self._make, self._parameters, self._first)
        env.close()
        return env.observation_space, env.action_space

    @cached_property
    def _camera(self) -> Camera:
        return Camera(self._make, self._parameters, self._first)

    def _plays(self, levels: TensorDictBase) -> list[GymLevel]:
        return plays(levels, self._parameters)

    def _env(self, levels: TensorDictBase, **how: Any) -> GymnasiumEnv:
        return GymnasiumEnv(levels, self._make, self._parameters, success=self._success, **how)

    def _specs(self, level: TensorDictBase) -> tuple[dict[str, TensorSpec], TensorSpec]:
        """Returns specs of observations and actions, and tries the network.

        Raises:
            ValueError: if no network fits them.
        """
        try:
            env = self._env(level)
            shown, acts = env.observation_spec[0], env.full_action_spec["action"][0]
            env.close()
            seen = {name: spec for name, spec in shown.items() if name not in FLAGS}
            SolverNetwork(list(seen.values()), acts, self._network)
        except (KeyError, RuntimeError, ValueError) as error:
            raise ValueError(f"network: {cause(error)}") from error
        return seen, acts


@contextmanager
def _named(env_id: str, extra: str | None) -> Iterator[None]:
    """Puts the key before errors of an environment, and says how to install a missing package."""
    try:
        yield
    except (ImportError, gymnasium.error.Error, UnfitEnvironmentError) as error:
        said = " ".join(str(error).split()).rstrip(".")
        if isinstance(error, ImportError | gymnasium.error.DependencyNotInstalled):
            said += f"; install with: {install_command(extra)}" if extra else where_to_look(error)
        elif isinstance(error, gymnasium.error.NameNotFound) and ":" not in env_id:
            said += "; for your own environment, name its module first, as in module:Name-v0"
        has_key = said.startswith(("success.", "parameters", "wrappers"))
        raise ValueError(said if has_key else f"env_id={env_id}: {said}") from error
