"""Robots that walk over terrains with steps, thousands at once, in torch alone."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values

DT = 0.1  # seconds of a step
APART = 1.0  # metres between two edges of the terrain
HIGHEST = 0.5  # of a foot
TILTED = 0.5  # lean beyond which a robot falls
FAR = 0.8  # share of the commanded way that is a success


class RobotEnv(BatchedEnv):
    """A body that leans over, with a foot that has to be lifted over every edge of the terrain.

    A level's ``step`` is the height of the edges, ``slope`` the slope of the ground between them,
    and ``speed`` the commanded speed. The three actions push forward, lift the foot, and turn the
    body, which is unstable. A lifted foot pushes less. A foot that is too low at an edge stops the
    robot and makes it stumble. The reward of a step grows with the closeness of the speed to the
    commanded one, to at most 1 in an episode, which ends when the body falls. A success is to stand
    at the end after most of the way.
    """

    state_size = 5
    observation_size = 8
    forces = 3
    draws = 3

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns first states [*B, 5], near rest: place, speed, foot, lean and its speed."""
        place, lean, turning = chance.unbind(-1)
        none = torch.zeros_like(place)
        state = [0.5 * APART * place, none, none, 0.1 * lean - 0.05, 0.1 * turning - 0.05]
        return torch.stack(state, -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the result of a step of Euler's method."""
        place, speed, foot, lean, turning = state.unbind(-1)
        push, lift, turn = action.unbind(-1)
        foot = (foot + 0.15 * lift).clamp(0, HIGHEST)
        force = 4 * push * (1 - foot / HIGHEST)
        speed = speed + DT * (force - 4 * level["slope"] - speed)
        moved = place + DT * speed
        edge = (moved / APART).floor() > (place / APART).floor()
        missing = (level["step"] - foot).clamp(min=0) * edge
        stumbles = missing > 0
        speed = torch.where(stumbles, 0.0, speed)
        moved = torch.where(stumbles, (moved / APART).floor() * APART, moved)
        shaken = 0.2 * (chance[..., 0] - 0.5) + 4 * missing
        turning = turning + DT * (4 * lean.sin() + 4 * turn - 0.5 * push - turning) + shaken
        lean = lean + DT * turning
        fell = lean.abs() > TILTED
        reward = (-4 * (speed - level["speed"]).square()).exp() / self.max_steps
        far = moved >= FAR * DT * self.max_steps * level["speed"]
        state = torch.stack([moved, speed, foot, lean, turning], -1)
        return Step(state, reward, fell, far & ~fell)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns observations of body and ground, each about -1 to 1."""
        place, speed, foot, lean, turning = state.unbind(-1)
        ahead = 1 - (place / APART).frac()
        body = [speed - 1, 4 * foot - 1, lean / TILTED, turning, 2 * ahead - 1]
        ground = [level["speed"] - 1, 4 * level["step"] - 1, 4 * level["slope"]]
        return torch.stack([*body, *ground], -1)
