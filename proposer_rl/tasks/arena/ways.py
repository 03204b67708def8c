"""Ways to the other end: corridors, ice, a ferry and a crowd."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values

DEEP = 0.97  # from which depth on the reward is at the left


class ForkEnv(BatchedEnv):
    """A corridor of cells that is entered in the middle.

    The reward of 1 is ``length`` cells to the right, and a trap two cells to the left, which ends
    an episode with nothing. In levels whose ``depth`` is above :data:`DEEP` it is the other way
    round, which is told by the depth that is seen alone.
    """

    state_size = 1
    observation_size = 3
    actions = 2

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the next cell, to the right by action 1, to the left by 0."""
        place = state.squeeze(-1) + 2 * action - 1
        right_way = torch.where(level["depth"] > DEEP, -place, place)
        end, trap = right_way >= level["length"], right_way <= -2
        return Step(place.unsqueeze(-1), end.float(), end | trap, end)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the place, the depth and the length, each about -1 to 1."""
        place = state.squeeze(-1) / 10
        return torch.stack([place, 2 * level["depth"] - 1, level["length"] / 5 - 1], -1)


DOORS, LONGEST = 4, 12


class RecallEnv(BatchedEnv):
    """A corridor of ``length`` cells, which has to be walked with a number from 0 to 3 in mind.

    The number is shown in the first cell, and in each later one another that means nothing, with
    the probability ``noise``. Action 0 goes on, the others go through a door, which there is in the
    last cell alone; the right one returns 1.
    """

    state_size = 3  # cell, door, number that is shown or -1
    observation_size = DOORS + 4
    actions = 1 + DOORS
    draws = 2

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 3]: the first cell, where the door is shown."""
        door = (DOORS * chance[..., 0]).floor()
        return torch.stack([torch.zeros_like(door), door, door], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the next cell, or the end of the episode behind a door."""
        cell, door, shown = state.unbind(-1)
        last = level["length"] - 1
        left = (cell >= last) & (action > 0)
        right = left & (action - 1 == door)
        walked = (action == 0) & (cell < last)
        cell = cell + walked
        other = torch.where(chance[..., 0] < level["noise"], (DOORS * chance[..., 1]).floor(), -1.0)
        shown = torch.where(cell > 0, other, shown)
        return Step(torch.stack([cell, door, shown], -1), right.float(), left, right)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns what is shown, whether here is the first or the last cell, and the level."""
        cell, _, shown = state.unbind(-1)
        number = functional.one_hot(shown.long() + 1, 1 + DOORS)[..., 1:]
        last = level["length"] - 1
        ends = [cell == 0, cell >= last, last / (LONGEST - 1), level["noise"]]
        return torch.cat([number, torch.stack([end.float() for end in ends], -1)], -1)


AHEAD, LEFT, RIGHT, WAIT = range(4)
SINK = -0.1  # what a pit costs


class IceEnv(BatchedEnv):
    """A walk along a strip of ``width`` cells, ``length`` of them, with pits on both sides.

    Instead of an action one slips to the left or to the right with the probability ``slip``. The
    end pays 1 and a pit slightly less than nothing, which is what is left when time is over.
    """

    state_size = 2
    observation_size = 5
    actions = 4
    draws = 2

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: the first cell of the middle row."""
        return torch.stack([torch.zeros_like(level["slip"]), level["width"] // 2], -1).float()

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the next cell, and whether it is a pit or the end."""
        along, across = state.unbind(-1)
        aside = torch.where(chance[..., 1] < 0.5, LEFT, RIGHT)
        move = torch.where(chance[..., 0] < level["slip"], aside, action)
        along = along + (move == AHEAD)
        across = across + (move == RIGHT).float() - (move == LEFT).float()
        pit = (across < 0) | (across >= level["width"])
        end = along >= level["length"]
        return Step(torch.stack([along, across], -1), end + SINK * pit, pit | end, end)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the cells to the end and to each side, the width and slip, about 0 to 1."""
        along, across = state.unbind(-1)
        left, right = across / 4, (level["width"] - 1 - across) / 4
        ahead = (level["length"] - along) / 14
        return torch.stack([ahead, left, right, level["width"] / 5, level["slip"] / 0.4], -1)


STEPS, STEER, GUST = 20, 0.1, 0.05


class FerryEnv(BatchedEnv):
    """A crossing of 20 steps, in which the ferry has to be steered against the river and gusts.

    A step carries it aside by a tenth of the level's ``current``, and of the rudder, -1 to 1, and
    by a gust at random. Success, which returns 1, is to be nearer to the dock than half its
    ``width`` when the other bank is reached.
    """

    state_size = 2  # how far aside, and across
    observation_size = 4
    draws = 1

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 2]: a place on the bank, about opposite the dock."""
        return torch.cat([0.4 * chance - 0.2, torch.zeros_like(chance)], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the ferry's next place, and whether it has landed."""
        drift = STEER * (level["current"] + action[..., 0]) + GUST * (2 * chance[..., 0] - 1)
        aside, across = state[..., 0] + drift, state[..., 1] + 1
        over = across >= STEPS
        landed = over & (aside.abs() < level["width"] / 2)
        return Step(torch.stack([aside, across], -1), landed.float(), over, landed)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns how far aside and across, current and width, each about -1 to 1."""
        aside, across = state.unbind(-1)
        seen = [aside, across / 10 - 1, level["current"], level["width"] - 1]
        return torch.stack(seen, -1)


LANES = (0.2, 0.4, 0.6, 0.8)  # where they walk from left to right or back
THICK = 0.05


class CrowdEnv(BatchedEnv):
    """A square that has to be crossed through four lanes with somebody in each of them.

    A step forward is as long as the level's ``pace``; the square is 1 deep. Its lanes are 2 long,
    and whoever leaves one at its end enters it at the other. The others, each ``size`` wide to
    both sides, walk with ``speed`` on average. To touch one ends the episode with 0, to be across
    with 1.
    """

    state_size = 1 + len(LANES)  # how far across, and where the others are
    observation_size = 4 + 2 * len(LANES)
    actions = 2  # wait or go forward
    draws = len(LANES)

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state: the agent below, the others anywhere in their lanes."""
        return torch.cat([torch.zeros_like(chance[..., :1]), 2 * chance - 1], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: all next places, the others' after steps of random length."""
        y = state[..., 0] + level["pace"] * action
        ways = 1 - 2 * (torch.arange(len(LANES), device=y.device) % 2)
        others = _around(state[..., 1:] + ways * 2 * chance * level["speed"].unsqueeze(-1))
        near = (y.new_tensor(LANES) - y.unsqueeze(-1)).abs() < THICK
        hit = (near & (others.abs() < level["size"].unsqueeze(-1))).any(-1)
        across = (y >= 1) & ~hit
        state = torch.cat([y.unsqueeze(-1), others], -1)
        return Step(state, across.float(), hit | across, across)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns how far it is, the level, where the others are, and how far it is to each."""
        y, others = state[..., :1], state[..., 1:]
        scaled = [20 * level["pace"] - 1, 10 * level["speed"] - 1, 4 * level["size"] - 1]
        lanes = state.new_tensor(LANES)
        return torch.cat([2 * y - 1, torch.stack(scaled, -1), others, 2 * (lanes - y)], -1)


def _around(x: Tensor) -> Tensor:
    """Returns places on the circle from -1 to 1."""
    return (x + 1) % 2 - 1
