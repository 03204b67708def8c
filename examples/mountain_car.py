"""Write your own task: on which mountain cars should a Solver train to master a weak engine?

A level is a gravity, an engine's power and a start. The target is a weak engine, with which random
actions hardly ever reach the top; a Proposer mixes 20 kinds of cars. `MountainCarTask` defines an
environment, a network and pictures; its base class is in `proposer_rl/task/base.py`.

    PYTHONPATH=examples bin/train --config-dir examples/conf task=mountain_car +method=perf_gain

trains on it. Then use bin/watch, bin/report and bin/eval as for any other run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from PIL import Image, ImageDraw
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import MLP

from proposer_rl import ComputeContext, SolverSettings, Task

GRAVITIES, POWERS = (0.25, 0.5, 0.75, 1.0), (0.35, 0.7, 1.05, 1.4, 1.75)
KINDS = torch.cartesian_prod(torch.tensor(GRAVITIES), torch.tensor(POWERS))
TARGET = torch.tensor([16])  # gravity 1, power 0.7
TOP = 0.5


class MountainCar(EnvBase):
    """A batch of Moore's cars in a valley; an action lasts for five physical steps."""

    def __init__(self, levels: TensorDictBase) -> None:
        super().__init__(batch_size=(batch := levels.batch_size))
        self.observation_spec = Composite(observation=Unbounded((*batch, 2)), shape=batch)
        self.action_spec, self.reward_spec = Categorical(3, batch), Unbounded((*batch, 1))
        self.set_levels(levels)

    def set_levels(self, levels: TensorDictBase) -> None:
        self.levels = levels

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        return self._state(self.levels["start"], torch.zeros(self.batch_size))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        place, speed = (tensordict["observation"] * torch.tensor([0.9, 0.07])).unbind(-1)
        engine = 0.001 * self.levels["power"] * (tensordict["action"] - 1)  # back, none, forth
        for _ in range(5):
            pull = 0.0025 * self.levels["gravity"] * torch.cos(3 * place)
            speed = (speed + engine - pull).clamp(-0.07, 0.07)
            place = (place + speed).clamp(-1.2, 0.6)
            speed = speed.where(place > -1.2, speed.clamp(min=0))
        state = self._state(place, speed)
        return state.set("reward", state["terminated"].float() - 0.01)

    def _state(self, place: Tensor, speed: Tensor) -> TensorDict:
        seen, top = torch.stack([place / 0.9, speed / 0.07], -1), (place >= TOP).unsqueeze(-1)
        return TensorDict({"observation": seen, "terminated": top}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is random."""


class Cars:
    """Cars of some kinds; as the Proposer's space, its bins are the kinds."""

    size = len(KINDS)
    coordinates = 2 * (KINDS - KINDS.amin(0)) / (KINDS.amax(0) - KINDS.amin(0)) - 1

    def __init__(self, kinds: Tensor) -> None:
        self.kinds = kinds
        self.axes = {"gravity": GRAVITIES, "power": POWERS}

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        kinds = self.kinds[torch.randint(len(self.kinds), (1, count), generator=generator)]
        return self.generate(kinds, [generator])[0]

    def generate(self, choices: Tensor, generators: Sequence[torch.Generator]) -> TensorDict:
        start = torch.stack([torch.rand(choices.shape[1], generator=g) for g in generators])
        gravity, power = KINDS[choices].unbind(-1)
        entries = {"gravity": gravity, "power": power, "start": 0.2 * start - 0.6}
        return TensorDict(entries, choices.shape)


class Network(nn.Module):
    """A network from observations to logits of three actions and a value."""

    def __init__(self) -> None:
        super().__init__()
        self.mlp = MLP(2, 4, 2, 32)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.mlp(observation).split([3, 1], -1)


class MountainCarTask(Task):
    """A task whose levels are tensordicts; evaluation plays the most probable actions."""

    title, noun, batched = "mountain cars", "cars", True
    key = "Blue: start. Orange: top. Purple: where the car was."
    exact_performance = True

    def __init__(self, *, levels: int, solver: SolverSettings, context: ComputeContext) -> None:
        target, kinds = Cars(TARGET), Cars(torch.arange(len(KINDS)))
        self.target_shares = torch.bincount(TARGET, minlength=len(KINDS)).float()
        super().__init__(
            distributions={"target": target, "all": kinds},
            target="target",
            space=kinds,
            solver=solver,
            context=context,
            levels=levels,
            greedy=True,
            measured={"levels": levels, "steps": solver.ppo.horizon},
        )

    def environment(self, levels: TensorDictBase) -> MountainCar:
        return MountainCar(levels)

    def network(self) -> nn.Module:
        return Network()

    def pictures(self, levels: TensorDictBase, rollout: TensorDictBase | None) -> list[np.ndarray]:
        places = [[float(level["start"])] for level in levels]
        if rollout is not None:
            seen = 0.9 * rollout["next", "observation"][..., 0]
            done = rollout["next", "done"].squeeze(-1).long()
            first = done.cumsum(-1) - done == 0
            places = [p + s[e].tolist() for p, s, e in zip(places, seen, first, strict=True)]
        return [draw_valley(where) for where in places]


def draw_valley(places: Sequence[float]) -> np.ndarray:
    """Draw the valley, the top, and the places of a car: uint8 [60, 120, 3]."""

    def at(x: float) -> tuple[float, float]:
        return 120 * (x + 1.2) / 1.8, 30 - 22 * math.sin(3 * x)

    def dot(x: float, colour: tuple[int, int, int], radius: float) -> None:
        across, down = at(x)
        draw.ellipse([across - radius, down - radius, across + radius, down + radius], colour)

    image = Image.new("RGB", (120, 60), (250, 250, 250))
    draw = ImageDraw.Draw(image)
    draw.line([at(-1.2 + 1.8 * i / 60) for i in range(61)], (45, 45, 45), 1)
    for place in places[1:]:
        dot(place, (204, 121, 167), 2)
    dot(places[0], (0, 114, 178), 4)
    dot(TOP, (230, 159, 0), 4)
    return np.asarray(image)
