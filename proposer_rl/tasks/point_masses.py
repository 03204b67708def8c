"""The point mass before a wall with a gate, as a TorchRL environment and as a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import torch
from annotated_types import Ge
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from tensordict import TensorDictBase
from torch import Tensor

from proposer_rl.learning import SolverSettings, in_first_episode
from proposer_rl.settings import settings
from proposer_rl.task import ComputeContext
from proposer_rl.tasks.batched_envs import BatchedEnv, BatchedTask, Step, Values
from proposer_rl.tasks.gymnasium.networks import NetworkSettings
from proposer_rl.tasks.ranges import RangeSettings

GATE = ("position", "width", "friction")
START_PLACE, GOAL_PLACE = (0.0, 3.0), (0.0, -3.0)
BORDER = 4.0  # of positions, on every side
FORCE, GAIN = 10.0, 1.5  # the largest, and acceleration per force
SUBSTEPS, DT = 10, 0.01  # of a step, and their seconds
STEEPNESS = 0.6  # of the reward
NEAR = 0.25  # distance from the goal that is a success


class PointMassEnv(BatchedEnv):
    """Point masses that must get through a gate in a wall and stay at a goal, as a batch.

    The environment of Klink et al. 2020 ("Self-Paced Deep Reinforcement Learning", arXiv
    2004.11812) and 2022 ("Curriculum Reinforcement Learning via Constrained Optimal Transport",
    ICML), without the noise of their accelerations (a deviation of 0.05, which hardly moves a
    mass). Nothing is drawn at random.

    - Level: ``position`` and ``width`` of the gate, and ``friction``.
    - Action: float32 ``[*B, 2]``, the force along x and y in shares of the largest, 10, held for a
      tenth of a second and clipped to -1 to 1.
    - Observation, which is also the state: float32 ``[*B, 7]``: x, its speed, y, its speed, and the
      level's position, width and friction.
    - Dynamics: ten Euler steps of 0.01 seconds; the acceleration is 1.5 times the force, less
      friction times the speed. Positions stay within -4 and 4. The mass begins at rest at (0, 3).
    - Reward: float32 ``[*B, 1]``, exp(-0.6 d) at the distance d from the goal at (0, -3).
    - End: ``terminated`` when the mass hits the wall, the line y = 0 beside the gate, where it
      stops; ``truncated`` after ``max_steps``. ``"success"``, bool ``[*B, 1]``, is whether an
      episode ends by the time limit less than 0.25 from the goal.

    Example:
        >>> from tensordict import TensorDict
        >>> level = {"position": torch.zeros(1), "width": torch.ones(1), "friction": torch.zeros(1)}
        >>> env = PointMassEnv(TensorDict(level, [1]))
        >>> down = env.reset().set("action", torch.tensor([[0.0, -1.0]]))
        >>> env.step(down)["next", "observation"][0, 2:4]
        tensor([ 2.9325, -1.5000])
    """

    state_size = 4 + len(GATE)
    observation_size = state_size
    forces = 2

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the first state: the mass at rest, and its level."""
        x, y = (torch.full_like(level[GATE[0]], place) for place in START_PLACE)
        rest = torch.zeros_like(x)
        return torch.stack([x, rest, y, rest, *(level[name] for name in GATE)], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the result of a step of ten substeps."""
        place, speed, hit = after_substeps(state, action)
        away = torch.hypot(place[0] - GOAL_PLACE[0], place[1] - GOAL_PLACE[1])
        mass = torch.stack([place[0], speed[0], place[1], speed[1]], -1)
        after = torch.cat([mass, state[..., 4:]], -1)
        return Step(after, (-STEEPNESS * away).exp(), hit, away < NEAR)


def after_substeps(state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns places and speeds after a step, and whether masses hit the wall on their way.

    Args:
        state: of masses, float [*B, 7].
        action: forces in shares of the largest, float [*B, 2] from -1 to 1.

    Returns:
        Places and speeds along x and y, float [2, *B], and hits, bool [*B].
    """
    x, x_speed, y, y_speed, gate, width, friction = state.unbind(-1)
    place, speed = torch.stack([x, y]), torch.stack([x_speed, y_speed])
    push = action.movedim(-1, 0) * (DT * GAIN * FORCE)
    kept = 1 - DT * friction
    path = [place]
    for _ in range(SUBSTEPS):
        place = place.add(speed, alpha=DT).clamp_(-BORDER, BORDER)
        speed = torch.addcmul(push, speed, kept)
        path.append(place)
    x, y = torch.stack(path, 1)  # [SUBSTEPS + 1, *B] each
    above = y > 0
    share = y[:-1] / (y[:-1] - y[1:])  # of a substep until the wall, where it is crossed
    there = x[:-1].lerp(x[1:], share)
    hits = (above[1:] ^ above[:-1]) & ((there - gate).abs() > width / 2)
    hit = hits.any(0)
    first = hits.to(torch.uint8).argmax(0, keepdim=True)
    at_wall = torch.stack([there.gather(0, first)[0], torch.zeros_like(gate)])
    return at_wall.where(hit, place), speed.masked_fill(hit, 0), hit


SIDE_PIXELS = 120  # of a picture


@settings
class GateSettings:
    """Settings of the parameters that differ between levels.

    Attributes:
        position: of the gate's middle along the wall.
        width: of the gate.
        friction: acceleration against the speed, per speed.
    """

    position: RangeSettings
    width: RangeSettings
    friction: RangeSettings


class PointMassTask(BatchedTask):
    """A point mass that must get through a gate in a wall, and stay at a goal behind it.

    Args:
        max_steps, network, levels, solver, context: as in
            :class:`~proposer_rl.tasks.batched_envs.BatchedTask`.
        parameters: what differs between levels.

    Raises:
        ArgumentError: naming the key, if a parameter is not valid.
    """

    title, noun, seeded = "point mass", "gates", False
    key = "The wall with its gate, the goal (orange), and the path of the mass."

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
        super().__init__(
            env=f"{__name__}.{PointMassEnv.__name__}",
            max_steps=max_steps,
            parameters=vars(parameters),
            network=network,
            levels=levels,
            solver=solver,
            context=context,
        )

    def pictures(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[NDArray[np.uint8]]:
        """Draws the walls of levels [n], and the mass's path in the first episode of [n, T]."""
        paths: list[Any] = [[]] * len(levels)
        if rollout is not None:
            first = in_first_episode(rollout)
            before, end = (part["observation"][..., [0, 2]] for part in (rollout, rollout["next"]))
            each = zip(before, end, first, strict=True)
            paths = [torch.cat([b[:1], e[f]]).tolist() for b, e, f in each]
        return list(map(gate_picture, levels["position"].tolist(), levels["width"].tolist(), paths))


def gate_picture(
    position: float, width: float, path: Sequence[Sequence[float]]
) -> NDArray[np.uint8]:
    """Draws a wall with its gate, the goal, and a path: uint8 [SIDE_PIXELS, SIDE_PIXELS, 3]."""

    def at(x: float, y: float) -> tuple[float, float]:
        return (x + BORDER) / (2 * BORDER) * SIDE_PIXELS, (BORDER - y) / (2 * BORDER) * SIDE_PIXELS

    def dot(place: Sequence[float], colour: tuple[int, int, int]) -> None:
        across, down = at(place[0], place[1])
        image.ellipse([across - 4, down - 4, across + 4, down + 4], colour)

    picture = Image.new("RGB", (SIDE_PIXELS, SIDE_PIXELS), (250, 250, 250))
    image = ImageDraw.Draw(picture)
    for ends in ((-BORDER, position - width / 2), (position + width / 2, BORDER)):
        if ends[0] < ends[1]:
            image.line([at(ends[0], 0.0), at(ends[1], 0.0)], (45, 45, 45), 4)
    dot(GOAL_PLACE, (230, 159, 0))
    if path:
        image.line([at(x, y) for x, y in path], (204, 121, 167), 2)
        dot(path[-1], (0, 114, 178))
    return np.asarray(picture)
