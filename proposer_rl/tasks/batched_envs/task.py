"""Any batched environment in torch as a task, by a file of settings."""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from annotated_types import Ge
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.learning import SolverSettings
from proposer_rl.settings import ArgumentError
from proposer_rl.task import ComputeContext, Levels, Task, named
from proposer_rl.tasks.batched_envs.env import BatchedEnv
from proposer_rl.tasks.gymnasium.networks import NetworkSettings, solver_network
from proposer_rl.tasks.gymnasium.player import imported
from proposer_rl.tasks.ranges import RangeSettings, spaces


class BatchedTask(Task):
    """A :class:`~proposer_rl.tasks.batched_envs.env.BatchedEnv` some of whose numbers make a level.

    Args:
        env: dotted name of the environment's class.
        max_steps: of an episode.
        parameters: what differs between levels, by name.
        network: of the Solver.
        levels: fixed evaluation levels of each distribution.
        solver: the Solver's training.
        context: device, precision and cores.

    Attributes:
        seeded: whether levels have seeds, which random numbers come from.

    Raises:
        ArgumentError: naming the key, if there is no such class, or for a parameter that is no
            range.
    """

    noun = "levels"
    batched: bool | None = True
    replayed = ("rollouts",)
    seeded: ClassVar[bool] = True

    def __init__(
        self,
        *,
        env: str,
        max_steps: Annotated[int, Ge(1)],
        parameters: dict[str, RangeSettings],
        network: NetworkSettings,
        levels: Annotated[int, Ge(1)],
        solver: SolverSettings,
        context: ComputeContext,
    ) -> None:
        self._class, self._network = _environment_class(env), network
        self.memory = network.memory
        self.title = getattr(self, "title", self._class.__name__.removesuffix("Env"))
        if network.memory is not None:
            self.batched = None
        space, target = spaces(parameters, seeded=self.seeded, device=context.device)
        self.edit, self.target_shares = space.edit, space.shares(target)
        super().__init__(
            distributions={"target": target, "all": space},
            target="target",
            space=space,
            solver=solver,
            context=context,
            levels=levels,
            max_steps=max_steps,
            measured={
                "environment": env,
                "levels": levels,
                "steps": max_steps,
                "parameters": {name: one.measured for name, one in parameters.items()},
            },
        )

    @property
    def about(self) -> dict[str, str]:
        """Returns texts about the task by their labels."""
        target = "; ".join(f"{name} {bins}" for name, bins in self.target.bins.items())
        return {"Target": target, **super().about}

    def environment(self, levels: TensorDictBase) -> EnvBase:
        """Returns an environment of levels [*B]."""
        return self._class(levels, max_steps=self.max_steps, device=self.device)

    def features(self, levels: Levels) -> Tensor:
        """Returns where levels [K, n] lie and the environment's own features: float [K, n, F]."""
        return torch.cat([super().features(levels), self._own_features(levels)], -1)

    def inputs(self, levels: Levels) -> Tensor:
        """Returns the environment's own features of levels [*B], or else where they lie."""
        own = self._own_features(levels)
        return own if own.shape[-1] else super().inputs(levels)

    def _own_features(self, levels: Levels) -> Tensor:
        level = {str(name): entry for name, entry in levels.items()}
        return self._class.features(level).double().cpu()

    def network(self) -> nn.Module:
        """Returns two MLPs, of the policy and of the critic, or a network with memory."""
        kind = self._class
        acts = Unbounded(kind.forces) if kind.actions is None else Categorical(kind.actions)
        return solver_network([Unbounded(kind.observation_size)], acts, self._network)


def _environment_class(name: str) -> type[BatchedEnv]:
    kind = named("env", imported, name)
    if not (isinstance(kind, type) and issubclass(kind, BatchedEnv)):
        raise ArgumentError(f"env={name!r}: must be a subclass of BatchedEnv")
    return kind
