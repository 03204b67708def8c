"""Points that are pushed, walk or jump to a goal."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values

FAR = 4.0  # about the largest distance
RADIUS = 0.3  # of the goal
DRAG, THRUST = 0.8, 0.03  # the largest speed of an axis is THRUST / (1 - DRAG)
COST = 0.002  # of a step with a force of length 1


class ReachEnv(BatchedEnv):
    """A point with drag that begins at the origin, and is rewarded at the goal alone.

    The goal lies at the level's ``distance`` in its ``direction``, in half turns. Forces cost a
    little, so that failures differ.
    """

    state_size = 4
    observation_size = 6
    forces = 2

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the point's next state, and whether it is at the goal."""
        velocity = DRAG * state[..., 2:] + THRUST * action
        place = state[..., :2] + velocity
        there = (goal(level) - place).square().sum(-1) <= RADIUS**2
        reward = there.float() - COST * action.square().sum(-1)
        return Step(torch.cat([place, velocity], -1), reward, there, there)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns where the goal is and lies from here, and the velocity, each about -1 to 1."""
        there, top = goal(level), THRUST / (1 - DRAG)
        apart = there - state[..., :2]
        return torch.cat([there / FAR, apart / FAR, state[..., 2:] / top], -1)


def goal(level: Values) -> Tensor:
    """Returns where the goals of levels [*B] lie, float [*B, 2]."""
    turn = torch.pi * level["direction"]
    return level["distance"].unsqueeze(-1) * torch.stack([turn.cos(), turn.sin()], -1)


STRIDE, NEAR = 0.2, 0.3


class LureEnv(BatchedEnv):
    """A trap with three walls, open towards the start, between the start and the goal.

    The goal is ``distance`` to the right of the start. Half-way stands a wall as high as the
    trap's ``width``; from both of its ends walls of a length of ``depth`` go back towards the
    start. A step returns how much nearer it gets; the goal ends the episode, with 1 more.
    """

    state_size = 2
    observation_size = 5
    forces = 2
    draws = 1

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: a place near the origin."""
        return torch.cat([torch.zeros_like(chance), 0.2 * chance - 0.1], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the next place, moved along x, then along y, up to walls."""
        x, y = state.unbind(-1)
        new_x, new_y = (state + STRIDE * action).unbind(-1)
        wall, half = level["distance"] / 2, level["width"] / 2
        held = ((x < wall) != (new_x < wall)) & (y.abs() < half)
        new_x = torch.where(held, x, new_x)
        beside = (new_x < wall) & (new_x > wall - level["depth"])
        held = beside & ((new_y.abs() < half) != (y.abs() < half))
        new_y = torch.where(held, y, new_y)
        before, after = (torch.hypot(level["distance"] - a, b) for a, b in ((x, y), (new_x, new_y)))
        there = after < NEAR
        return Step(torch.stack([new_x, new_y], -1), before - after + there, there, there)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the place, and the trap's depth, distance and width, each about -1 to 1."""
        seen = [level["depth"] - 1, level["distance"] / 2 - 2, level["width"] - 1]
        return torch.cat([state / 2, torch.stack(seen, -1)], -1)


PACE = 0.3
BORDER, BLOCK = 7.0, 5.0  # the floor ends at the first, and begins at the second
REACH = 9.0  # goals lie within it, many of them in walls


class GoalMazeEnv(BatchedEnv):
    """The sparse goal reaching of Klink et al. 2022, ICML (CurrOT).

    The floor is a corridor around a block. An episode begins in the lower left corner, and returns
    1 as soon as the point is nearer to the goal (``x``, ``y``) than ``tolerance``, and 0 else.
    """

    state_size = 2
    observation_size = 5
    forces = 2
    draws = 2

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: a place in the corner."""
        return (BORDER - BLOCK) * chance - BORDER

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the next place; a wall stops the axis on which it is met."""
        length = action.norm(dim=-1, keepdim=True).clamp(min=1)
        place = (state + PACE * action / length).clamp(-BORDER, BORDER)
        inside = (place.abs() < BLOCK).all(-1, keepdim=True)
        stopped = torch.where(state.abs() >= BLOCK, BLOCK * state.sign(), place)
        place = torch.where(inside, stopped, place)
        goal = torch.stack([level["x"], level["y"]], -1)
        there = (goal - place).norm(dim=-1) < level["tolerance"]
        return Step(place, there.float(), there, there)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the place, the goal and the tolerance, each from -1 to 1."""
        seen = torch.stack([level["x"], level["y"], level["tolerance"] - REACH], -1)
        return torch.cat([state, seen], -1) / REACH


FIRST, LAST = 2.0, 16.0  # where the first stump begins, and where the track ends
WIDTH, CLEARANCE = 0.5, 0.2  # of a stump, and how low ones a stride steps over
PUSH, TOP = 0.1, 0.4  # forward acceleration and speed
GRAVITY, JUMP, REST, SLIP = 0.05, 0.3, 0.2, 0.1
FALL = -0.1  # what a fall costs, where the whole track pays 1


class StumpsEnv(BatchedEnv):
    """A walker, a point, on a track of stumps of a ``height``, with a ``spacing`` between them.

    Its first action speeds it up or slows it down, the second one, above 0, lets it jump; in the
    air neither does anything. A jump is as strong as the legs are rested, which takes five steps
    on the ground, and slightly weaker at random. To touch a stump is a fall, which ends the
    episode; the end of the track is a success.
    """

    state_size = 5  # place, height, speed along and upwards, rest
    observation_size = 9
    forces = 2
    draws = 1

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 5]: the walker at the beginning, at rest."""
        nothing = torch.zeros_like(chance).expand(*chance.shape[:-1], 4)
        return torch.cat([nothing, 1 + 0 * chance], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the walker's next state, and whether it has fallen."""
        x, y, along, upwards, rest = state.unbind(-1)
        stands = y <= 0
        jumps = stands & (action[..., 1] > 0)
        along = torch.where(stands, (along + PUSH * action[..., 0]).clamp(-TOP, TOP), along)
        leap = JUMP * rest * (1 - SLIP * chance[..., 0])
        upwards = torch.where(stands, leap * jumps, upwards - GRAVITY)
        rest = torch.where(jumps, 0.0, (rest + REST * stands).clamp(max=1))
        to_x, y = x + along, (y + upwards).clamp(min=0)
        over, _ = _stumps(to_x, level)
        falls = over & (y + CLEARANCE < level["height"])
        there = (to_x >= LAST) & ~falls
        reward = (to_x - x) / LAST + FALL * falls
        state = torch.stack([to_x, y, along, upwards, rest], -1)
        return Step(state, reward, falls | there, there)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the walker, the stump below and the next one, and the level, about -1 to 1."""
        x, y, along, upwards, rest = state.unbind(-1)
        over, ahead = _stumps(x, level)
        walker = [2 * x / LAST - 1, y, along / TOP, upwards / JUMP, 2 * rest - 1]
        track = [over, ahead / 3 - 1, level["height"] / 1.5 - 1, level["spacing"] / 3 - 1]
        return torch.stack([*walker, *track], -1)


def _stumps(x: Tensor, level: Values) -> tuple[Tensor, Tensor]:
    """Returns whether there is a stump at a place, and how far it is to where the next begins."""
    period = level["spacing"] + WIDTH
    phase = (x - FIRST) % period
    begun = x >= FIRST
    return begun & (phase < WIDTH), torch.where(begun, period - phase, FIRST - x)
