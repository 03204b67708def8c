"""The point mass before a wall with a gate, as a TorchRL environment."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values

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
