"""Any Gymnasium environment as a task: Solvers, levels and how they are measured."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from functools import cached_property
from typing import Annotated, Any

import gymnasium
import numpy as np
import torch
from annotated_types import Ge, Gt
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.extras import install_command
from proposer_rl.settings import SolverSettings
from proposer_rl.streams import Streams
from proposer_rl.task import ComputeContext, Task
from proposer_rl.tasks.gymnasium.env import GymnasiumEnv, Vectorization, plays
from proposer_rl.tasks.gymnasium.networks import Acts, SolverNetwork, checked_spaces
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
from proposer_rl.tasks.parameters import SEED, ParameterSpace

# Columns of the table of training, where parameters have one each, too; beside PPO's ``loss_...``.
OF_PPO = {"entropy", "kl_approx", "clip_fraction", "explained_variance", "grad_norm"}
RESERVED = {SEED, "updates", "train_success", "train_return", *OF_PPO}


class GymnasiumTask(Task):
    """An environment of Gymnasium some of whose numbers make a level.

    Environments are stepped by Gymnasium's vector environments, Solvers are small networks: both
    are on the CPU, whatever the context says.

    Args:
        env_id: as :func:`gymnasium.make` takes it; ``module:name`` imports the module first.
        arguments: of the environment's constructor.
        wrappers: dotted names of functions or classes that are put around each environment, the
            innermost first.
        max_steps: after which an episode is truncated; None for the environment's own limit.
        parameters: what differs between levels, by name.
        success: when an episode is one.
        reward_scale: what rewards are multiplied with in training; returns are given without it.
        network: of the Solver.
        evaluation: how the Solver is measured.
        vectorization: of the environments that Solvers train in: ``"sync"``, or ``"async"`` for a
            process each.
        extra: of this package, that the environment needs; None for none.
        solver: the Solver's training.
        context: precision and cores.

    Raises:
        ValueError: naming the key, if there is no such environment or parameter, it refuses a value
            of a parameter, there is no network for what it shows or takes, or a package is missing.
    """

    episodes_at_once = 64

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
        context: ComputeContext,
    ) -> None:
        self._parameters = parameters
        self._make = MakeEnvironment(env_id, arguments, max_steps, wrappers)
        success.check()
        self._success = success
        self.reward_scale = reward_scale
        self._network = network
        self._evaluation = evaluation
        self._vectorization = vectorization
        self._envs: dict[torch.Size, GymnasiumEnv] = {}
        space, target = _spaces(parameters)
        super().__init__(
            distributions={"target": target, "all": space},
            target="target",
            space=space,
            solver=solver,
            context=context._replace(device=torch.device("cpu")),
            levels=evaluation.levels,
            seed=evaluation.seed,
            episodes=evaluation.episodes,
            greedy=evaluation.actions == "most_probable",
        )
        self.title = env_id
        with _named(env_id, extra):
            self._seen, self._acts, self.max_steps = self._tried()
        # MLPs as small as these are faster all at once.
        self.batched = True if len(self._seen.shape) == 1 else None
        self._measured = {
            "environment": [env_id, arguments, list(wrappers)],
            "steps": self.max_steps,
            "parameters": {name: asdict(p) for name, p in parameters.items()},
            "success": asdict(success),
            "evaluation": asdict(evaluation),
        }

    @property
    def target_shares(self) -> Tensor:
        """The target as shares of the bins, what lies outside of them in the nearest: float [N]."""
        shares: Tensor = self.space.shares(self.target)
        return shares

    @property
    def key(self) -> str:  # type: ignore[override]
        """What is to be seen in a record's picture."""
        return KEY if self._camera.works else NO_FRAMES

    @property
    def about(self) -> dict[str, str]:
        """Texts about the task, by their labels."""
        evaluation = self._evaluation
        return {
            "Environment": f"{self.title}, at most {self.max_steps} steps",
            "Target": "; ".join(
                f"{name} {' or '.join(_range(*ends) for ends in zip(*bins, strict=True))}"
                for name, bins in self.target.bins.items()
            ),
            "Measured on": f"{evaluation.levels} fixed levels of the target, and as many of "
            f"all bins; {evaluation.episodes} episode(s) on each, with "
            f"{evaluation.actions.replace('_', ' ')} actions",
        }

    def environment(self, levels: TensorDictBase) -> GymnasiumEnv:
        """Environments to be trained in."""
        return self._env(levels, vectorization=self._vectorization)

    def evaluation_environment(self, levels: TensorDictBase) -> GymnasiumEnv:
        """The same environments for the same number of levels, played once and one by one.

        Of the levels of evaluations a process each would be too many.
        """
        shape = levels.batch_size
        if shape not in self._envs:
            self._envs[shape] = self._env(levels, once=True)
        self._envs[shape].set_levels(levels)
        return self._envs[shape]

    def network(self) -> SolverNetwork:
        """The network of one Solver, by what the environment shows and takes."""
        return SolverNetwork(self._seen, self._acts, self._network)

    def stream(self, use: str, name: str) -> torch.Generator:
        """What ``"levels"`` of evaluations on a distribution, or their ``"actions"``, come from."""
        return Streams(self._evaluation.seed, "evaluation").generator(use, name)

    def record(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[dict[str, Any]]:
        """Frames of levels [n], and of the Solver's first episode there [n, T]; the parameters."""
        records = super().record(levels, rollout)
        return [
            {**record, "level": {**play.values, SEED: play.seed}}
            for record, play in zip(records, plays(levels), strict=True)
        ]

    def pictures(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[NDArray[np.uint8]]:
        """Frames of levels [n], and of the Solver's first episode there [n, T]."""
        return self._camera.pictures(levels, rollout)

    @cached_property
    def _camera(self) -> Camera:
        first = plays(self.evaluated_on["target"][:1])[0]
        return Camera(self._make, self._parameters, first)

    def _env(self, levels: TensorDictBase, **how: Any) -> GymnasiumEnv:
        return GymnasiumEnv(
            levels,
            self._make,
            self._parameters,
            success=self._success,
            reward_scale=self.reward_scale,
            **how,
        )

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
        target = plays(self.evaluated_on["target"][:1])[0]
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
                raise ValueError("is a column of training.csv; choose another name")
            if not re.fullmatch(r"\w[\w .-]*", name):
                raise ValueError("must be a name of letters, digits, spaces, dots and dashes")
            bins[name], target[name] = settings.space_bins(), settings.target_bins()
        except ValueError as error:
            raise ValueError(f"parameters.{name}: {error}") from error
    return ParameterSpace(bins), ParameterSpace(target)


@contextmanager
def _named(env_id: str, extra: str | None) -> Iterator[None]:
    """Say in one line what is wrong with an environment that cannot be made."""
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


def _range(low: Tensor, high: Tensor) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
