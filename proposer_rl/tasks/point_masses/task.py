"""A point mass before a wall with a gate: the environment in TorchRL, and the task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated

import numpy as np
import torch
from annotated_types import Ge
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from proposer_rl.learning import SolverSettings, in_first_episode
from proposer_rl.models import own_state, population
from proposer_rl.settings import settings, signed
from proposer_rl.task import ComputeContext, Task
from proposer_rl.tasks.gymnasium.networks import NetworkSettings, SolverNetwork
from proposer_rl.tasks.ranges import RangeSettings, spaces

GATE = ("position", "width", "friction")
START_PLACE, GOAL_PLACE = (0.0, 3.0), (0.0, -3.0)
BORDER = 4.0  # of positions, on every side
FORCE, GAIN = 10.0, 1.5  # the largest, and acceleration per force
SUBSTEPS, DT = 10, 0.01  # of a step, and their seconds
STEEPNESS = 0.6  # of the reward
NEAR = 0.25  # from the goal is a success


@signed
class PointMassEnv(EnvBase):
    """Point masses that are to get through a gate in a wall and to stay at a goal, a batch of them.

    The environment of Klink et al. 2020 ("Self-Paced Deep Reinforcement Learning", arXiv
    2004.11812) and 2022 ("Curriculum Reinforcement Learning via Constrained Optimal Transport",
    ICML), without the noise of their accelerations (a deviation of 0.05, which hardly moves a
    mass): nothing is drawn at random.

    - Action: float32 ``[*B, 2]``, the force along x and y in shares of the largest, 10, held for a
      tenth of a second. What is beyond -1 and 1 is clipped.
    - Observation: ``"observation"``, float32 ``[*B, 7]``: x, its speed, y, its speed, and the
      level: the gate's position and width, and the friction.
    - State besides: ``"step_count"``, int64 ``[*B, 1]``.
    - Dynamics: ten Euler steps of 0.01 seconds; the acceleration is 1.5 times the force, less
      friction times the speed. Positions stay within -4 and 4. The mass begins at rest at (0, 3).
    - Reward: float32 ``[*B, 1]``, exp(-0.6 d) at the distance d from the goal at (0, -3).
    - End: ``terminated`` where the mass hits the wall, the line y = 0 beside the gate, and stops
      there; ``truncated`` after ``max_steps``. ``"success"``, bool ``[*B, 1]``, is whether an
      episode ends with the time limit and less than 0.25 from the goal.

    Args:
        levels: with entries ``position``, ``width`` and ``friction`` ``[*B]``.
        max_steps: step limit of an episode.
        device: of the states.

    Example:
        >>> level = {"position": torch.zeros(1), "width": torch.ones(1), "friction": torch.zeros(1)}
        >>> env = PointMassEnv(TensorDict(level, [1]))
        >>> down = env.reset().set("action", torch.tensor([[0.0, -1.0]]))
        >>> env.step(down)["next", "observation"][0, 2:4]
        tensor([ 2.9325, -1.5000])
    """

    @own_state()
    def __init__(
        self,
        levels: TensorDictBase,
        *,
        max_steps: int = 100,
        device: torch.device | str = "cpu",
    ) -> None:
        batch = levels.batch_size
        super().__init__(device=device, batch_size=batch, allow_done_after_reset=True)
        self.max_steps = max_steps
        flag = Binary(1, (*batch, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            observation=Unbounded((*batch, 4 + len(GATE))),
            step_count=Unbounded((*batch, 1), dtype=torch.int64),
            success=flag,
            shape=batch,
        ).to(self.device)
        self.action_spec = Unbounded((*batch, 2), device=self.device)
        self.reward_spec = Unbounded((*batch, 1), device=self.device)
        ends = {key: flag.clone() for key in ("done", "terminated", "truncated")}
        self.done_spec = Composite(ends, shape=batch).to(self.device)
        mass = torch.tensor([START_PLACE[0], 0.0, START_PLACE[1], 0.0, *[0.0] * len(GATE)])
        self._first = mass.to(self.device).repeat(*batch, 1)
        self.set_levels(levels)

    def set_levels(self, levels: TensorDictBase) -> None:
        """Sets levels [*B], which each mass plays from its next reset on.

        Raises:
            ValueError: if they are of another batch shape.
        """
        if levels.batch_size != self.batch_size:
            raise ValueError(
                f"levels must keep the environment's batch shape {list(self.batch_size)}, "
                f"got {list(levels.batch_size)}"
            )
        self._first[..., -len(GATE) :] = torch.stack([levels[n].float() for n in GATE], -1)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begins ended episodes anew, without asking a GPU first whether there are any."""
        done = tensordict["done"]
        if population.at_hand(done):
            return super().maybe_reset(tensordict)
        begun = self._reset()
        return tensordict.copy().update(
            {key: begun[key].where(done, tensordict[key]) for key in begun.keys()}
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDict:
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        # Of these TorchRL takes over only the entries of the masses that are reset.
        return self._state(self._first.clone(), none.long(), none, none)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        seen = tensordict["observation"]
        place, speed, hit = after_substeps(seen, tensordict["action"])
        mass = torch.stack([place[0], speed[0], place[1], speed[1]], -1)
        steps = tensordict["step_count"] + 1
        terminated = hit.unsqueeze(-1)
        away = torch.hypot(place[0] - GOAL_PLACE[0], place[1] - GOAL_PLACE[1]).unsqueeze(-1)
        truncated = (steps >= self.max_steps) & ~terminated
        state = self._state(torch.cat([mass, seen[..., 4:]], -1), steps, terminated, truncated)
        state.set("success", truncated & (away < NEAR))
        return state.set("reward", (-STEEPNESS * away).exp())

    def _state(
        self, seen: Tensor, steps: Tensor, terminated: Tensor, truncated: Tensor
    ) -> TensorDict:
        entries = {
            "observation": seen,
            "step_count": steps,
            "success": torch.zeros_like(terminated),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        return TensorDict(entries, self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Does nothing, as nothing is random."""


def after_substeps(seen: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns where masses are after a step, and whether they hit the wall on their way.

    Args:
        seen: observations, float [*B, 7].
        action: forces in shares of the largest, float [*B, 2].

    Returns:
        Places and speeds along x and y, float [2, *B], and bool [*B].
    """
    x, x_speed, y, y_speed, gate, width, friction = seen.unbind(-1)
    place, speed = torch.stack([x, y]), torch.stack([x_speed, y_speed])
    push = action.movedim(-1, 0).clamp(-1, 1) * (DT * GAIN * FORCE)
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


SIDE_PIXELS = 120  # pixels of a picture


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
        """Returns texts about the task by their labels."""
        target = "; ".join(f"{name} {bins}" for name, bins in self.target.bins.items())
        return {"Target": target, **super().about}

    def environment(self, levels: TensorDictBase) -> PointMassEnv:
        """Returns an environment of masses before their gates."""
        return PointMassEnv(levels, max_steps=self.max_steps, device=self.device)

    def network(self) -> nn.Module:
        """Returns two MLPs, of the policy and of the critic."""
        return SolverNetwork([Unbounded(4 + len(GATE))], Unbounded(2), self._network)

    def pictures(
        self, levels: TensorDictBase, rollout: TensorDictBase | None
    ) -> list[NDArray[np.uint8]]:
        """Draws the walls of levels [n], and the mass's path in the first episode of [n, T]."""
        gates = list(zip(levels["position"].tolist(), levels["width"].tolist(), strict=True))
        if rollout is None:
            return [gate_picture(x, width, []) for x, width in gates]
        first = in_first_episode(rollout)
        before, end = (part["observation"][..., [0, 2]] for part in (rollout, rollout["next"]))
        ways = [torch.cat([b[:1], e[f]]) for b, e, f in zip(before, end, first, strict=True)]
        return [gate_picture(*gate, way.tolist()) for gate, way in zip(gates, ways, strict=True)]


def gate_picture(
    position: float, width: float, way: Sequence[Sequence[float]]
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
    if way:
        image.line([at(x, y) for x, y in way], (204, 121, 167), 2)
        dot(way[-1], (0, 114, 178))
    return np.asarray(picture)
