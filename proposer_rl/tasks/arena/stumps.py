"""A track of stumps, which a walker has to jump over."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs.env import BatchedEnv, Step, Values

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
