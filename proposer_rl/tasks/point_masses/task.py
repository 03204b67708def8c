"""The point mass before a gate as a task: Solvers, gates, and how they are measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import Unbounded

from proposer_rl.learning import SolverSettings, in_first_episode
from proposer_rl.settings import settings
from proposer_rl.task import ComputeContext, Task
from proposer_rl.tasks.gymnasium.networks import SolverNetwork
from proposer_rl.tasks.gymnasium.settings import NetworkSettings
from proposer_rl.tasks.point_masses.env import BORDER, GOAL, LEVEL, PointMassEnv
from proposer_rl.tasks.ranges import RangeSettings, spaces

SIDE = 120  # pixels of a picture


@settings
class GateSettings:
    """What differs between levels.

    Attributes:
        position: of the gate's middle along the wall.
        width: of the gate.
        friction: acceleration against the speed, per speed.
    """

    position: RangeSettings
    width: RangeSettings
    friction: RangeSettings


class PointMassTask(Task):
    """A point mass that is to get through a gate in a wall, and to stay at a goal behind it.

    Args:
        max_steps: of an episode.
        parameters: what differs between levels.
        network: of the Solver.
        levels: fixed evaluation levels of each distribution.
        solver: the Solver's training.
        context: device, precision and cores.

    Raises:
        ValueError: naming the key, for a parameter that is no range, or below zero where it cannot
            be.
    """

    title, noun, batched = "point mass", "gates", True
    key = "The wall with its gate, the goal (orange), and the way of the mass."
    replayed = ("rollouts",)

    def __init__(
        self,
        *,
        max_steps: Annotated[int, Ge(1)],
        parameters: GateSettings,
        network: NetworkSettings,
        levels: Annotated[int, Ge(1)],
        solver: SolverSettings,
        context: ComputeContext,
    ) -> None:
        self._network = network
        space, target = spaces(vars(parameters), seeded=False, device=context.device)
        for name in ("width", "friction"):
            for bins in (space.bins[name], target.bins[name]):
                if bins.low[0] < 0:
                    raise ValueError(f"parameters.{name}: {bins:} goes below zero")
        self.edit, self.target_shares = space.edit, space.shares(target)
        super().__init__(
            distributions={"target": target, "all": space},
            target="target",
            space=space,
            solver=solver,
            context=context,
            levels=levels,
            max_steps=max_steps,
            measured={"levels": levels, "steps": max_steps, "parameters": asdict(parameters)},
        )

    @property
    def about(self) -> dict[str, str]:
        """Texts about the task, by their labels."""
        target = "; ".join(f"{name} {bins}" for name, bins in self.target.bins.items())
        return {"Target": target, **super().about}

    def environment(self, levels: TensorDictBase) -> PointMassEnv:
        """Masses before their gates."""
        return PointMassEnv(levels, max_steps=self.max_steps, device=self.device)

    def network(self) -> nn.Module:
        """Two MLPs, of the policy and of the critic."""
        return SolverNetwork([Unbounded(4 + len(LEVEL))], Unbounded(2), self._network)

    def pictures(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[NDArray[np.uint8]]:
        """The walls of levels [n], and where the mass was in the first episode of [n, T]."""
        gates = list(zip(levels["position"].tolist(), levels["width"].tolist(), strict=True))
        if rollout is None:
            return [draw(x, width, []) for x, width in gates]
        first = in_first_episode(rollout)
        before, end = (part["observation"][..., [0, 2]] for part in (rollout, rollout["next"]))
        ways = [torch.cat([b[:1], e[f]]) for b, e, f in zip(before, end, first, strict=True)]
        return [draw(*gate, way.tolist()) for gate, way in zip(gates, ways, strict=True)]


def draw(position: float, width: float, way: Sequence[Sequence[float]]) -> NDArray[np.uint8]:
    """A wall with its gate, the goal, and a way: uint8 [SIDE, SIDE, 3]."""

    def at(x: float, y: float) -> tuple[float, float]:
        return (x + BORDER) / (2 * BORDER) * SIDE, (BORDER - y) / (2 * BORDER) * SIDE

    def dot(place: Sequence[float], colour: tuple[int, int, int]) -> None:
        across, down = at(place[0], place[1])
        image.ellipse([across - 4, down - 4, across + 4, down + 4], colour)

    picture = Image.new("RGB", (SIDE, SIDE), (250, 250, 250))
    image = ImageDraw.Draw(picture)
    for ends in ((-BORDER, position - width / 2), (position + width / 2, BORDER)):
        if ends[0] < ends[1]:
            image.line([at(ends[0], 0.0), at(ends[1], 0.0)], (45, 45, 45), 4)
    dot(GOAL, (230, 159, 0))
    if way:
        image.line([at(x, y) for x, y in way], (204, 121, 167), 2)
        dot(way[-1], (0, 114, 178))
    return np.asarray(picture)
