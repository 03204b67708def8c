"""Write a whole task in forty lines: stop a sledge on ice at a given place, against the wind.

    PYTHONPATH=examples bin/train --config-dir examples/conf task=own_task +method=currot

trains on it. Then use bin/watch, bin/report and bin/eval as for any other run. Further methods that
a task may define, such as pictures of levels, are in `proposer_rl/task/base.py`.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl import ComputeContext, SolverSettings, Task
from proposer_rl.tasks.parameters import ParameterSpace, intervals, points


class Sledges(EnvBase):
    """A batch of sledges, which actions push back, not at all, or forth."""

    def __init__(self, levels: TensorDictBase) -> None:
        super().__init__(batch_size=(batch := levels.batch_size))
        self.observation_spec = Composite(observation=Unbounded((*batch, 3)), shape=batch)
        self.action_spec, self.reward_spec = Categorical(3, batch), Unbounded((*batch, 1))
        self.set_levels(levels)

    def set_levels(self, levels: TensorDictBase) -> None:
        self.levels = levels.float()

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        left, wind = self.levels["distance"], self.levels["wind"]
        return self._state(left, torch.zeros_like(left), wind)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        left, speed, wind = tensordict["observation"].unbind(-1)
        speed = speed + 0.2 * (tensordict["action"] - 1) - 0.1 * wind
        state = self._state(left - speed, speed, wind)
        return state.set("reward", state["terminated"].float() - 0.01)

    def _state(self, left: Tensor, speed: Tensor, wind: Tensor) -> TensorDict:
        there = ((left.abs() < 0.3) & (speed.abs() < 0.3)).unsqueeze(-1)
        seen = torch.stack([left, speed, wind], -1)
        return TensorDict({"observation": seen, "terminated": there}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


class Network(nn.Module):
    """A network from observations to logits of three actions and a value."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(3, 32), nn.Tanh(), nn.Linear(32, 4))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.body(observation).split([3, 1], -1)


class SledgeTask(Task):
    """A task of distances and winds; the target is large distances against a strong wind."""

    title, noun, batched = "sledges", "sledges", True

    def __init__(self, *, levels: int, solver: SolverSettings, context: ComputeContext) -> None:
        space = ParameterSpace({"distance": intervals(1.0, 9.0, 4), "wind": points([0, 1])})
        far = ParameterSpace({"distance": intervals(7.0, 9.0), "wind": points([1])})
        self.target_shares = space.shares(far)  # for curricula that move towards the target
        distributions = {"target": far, "all": space}
        kinds = {"distributions": distributions, "target": "target", "space": space}
        super().__init__(**kinds, solver=solver, context=context, levels=levels)

    def environment(self, levels: TensorDictBase) -> Sledges:
        return Sledges(levels)

    def network(self) -> nn.Module:
        return Network()
