"""Classical control with physics that differ: a cart with a pole, a car in a valley, a pendulum."""

from __future__ import annotations

import torch
from torch import Tensor

from proposer_rl.tasks.batched_envs import BatchedEnv, Step, Values

# What is seen of a level, with the middle and half the width of its usual range.
PHYSICS = {
    "gravity": (15.0, 10.0),
    "cart": (1.5, 1.25),
    "pole": (0.5, 0.45),
    "length": (0.6, 0.5),
    "force": (10.5, 9.5),
    "tau": (0.03, 0.02),
    "friction": (0.5, 0.5),
}
EDGE, FALLEN = 2.4, 12 * torch.pi / 180


class CartEnv(BatchedEnv):
    """Cart and pole after Barto et al. 1983, with the contexts of CARL (Benjamins et al. 2023).

    A level's ``gravity``, masses of ``cart`` and ``pole``, half ``length`` of the pole, ``force``
    of a push, seconds ``tau`` of a step and ``friction`` of the cart are its physics; whatever else
    it has does nothing. Every step returns 1. Success is to survive them all.
    """

    state_size = 4
    observation_size = 4 + len(PHYSICS)
    actions = 2
    draws = 4

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial place, speed, angle and angular speed [*B, 4], each within ±0.05."""
        return 0.1 * chance - 0.05

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the four numbers after a step of Euler's method."""
        place, speed, angle, turning = state.unbind(-1)
        total, moment = level["cart"] + level["pole"], level["pole"] * level["length"]
        sine, cosine = angle.sin(), angle.cos()
        push = (2 * action - 1) * level["force"] - level["friction"] * speed
        pull = (push + moment * turning.square() * sine) / total
        turn = (level["gravity"] * sine - cosine * pull) / (
            level["length"] * (4 / 3 - level["pole"] * cosine.square() / total)
        )
        gain = pull - moment * turn * cosine / total
        change = torch.stack([speed, gain, turning, turn], -1)
        state = state + level["tau"].unsqueeze(-1) * change
        lost = (state[..., 0].abs() > EDGE) | (state[..., 2].abs() > FALLEN)
        return Step(state, torch.ones_like(place), lost, ~lost)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the state and the physics, each about -1 to 1."""
        physics = [(level[name] - middle) / half for name, (middle, half) in PHYSICS.items()]
        scale = state.new_tensor([EDGE, 2.0, FALLEN, 2.0])
        return torch.cat([state / scale, torch.stack(physics, -1)], -1)


class HillEnv(BatchedEnv):
    """Gymnasium's MountainCar-v0 with engines of many strengths, and without a reward on the way.

    The level's ``force`` is the acceleration of the engine; 0.001 is Gymnasium's. An episode ends
    with 1 on the top, and returns 0 else.
    """

    state_size = 2
    observation_size = 3
    actions = 3
    draws = 1

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial place near the bottom and speed 0, [*B, 2]."""
        place = -0.6 + 0.2 * chance
        return torch.cat([place, torch.zeros_like(place)], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the car's next place and speed."""
        place, speed = state.unbind(-1)
        push = (action - 1) * level["force"] - 0.0025 * (3 * place).cos()
        speed = (speed + push).clamp(-0.07, 0.07)
        place = (place + speed).clamp(-1.2, 0.6)
        speed = torch.where((place <= -1.2) & (speed < 0), 0.0, speed)
        top = place >= 0.5
        return Step(torch.stack([place, speed], -1), top.float(), top, top)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns place, speed and the engine's force, each about -1 to 1."""
        place, speed = state.unbind(-1)
        return torch.stack([place + 0.3, speed / 0.07, level["force"] / 0.003 - 1], -1)


GRAVITY, FASTEST = 10.0, 8.0  # as in Gymnasium's Pendulum-v1
SECONDS = 0.06  # of a step
UPRIGHT, HELD = 0.9, 12  # cosine of the angle, and for how many steps in a row it is a success


class SwingEnv(BatchedEnv):
    """Gymnasium's Pendulum-v1 with other masses, lengths and engines, which hangs at first.

    The level's ``torque`` is the strongest; a pendulum of mass and length 1 is held level by 5.
    The reward of a step rises from 0 below to 0.02 above, less a little for speed; a success is
    upright in all of the last :data:`HELD` steps.
    """

    state_size = 3  # angle, speed, steps upright
    observation_size = 6
    draws = 1

    def begin(self, level: Values, chance: Tensor) -> Tensor:
        """Returns the initial state [*B, 3]: the pendulum hangs about straight down, at rest."""
        angle = torch.pi + chance - 0.5
        return torch.cat([angle, torch.zeros_like(angle), torch.zeros_like(angle)], -1)

    def advance(self, state: Tensor, action: Tensor, level: Values, chance: Tensor) -> Step:
        """Returns the step's result: the pendulum's next angle and speed, and its steps upright."""
        angle, speed, held = state.unbind(-1)
        mass, length = level["mass"], level["length"]
        torque = action.squeeze(-1) * level["torque"]
        pull = 1.5 * GRAVITY / length * angle.sin() + 3 * torque / (mass * length**2)
        speed = (speed + SECONDS * pull).clamp(-FASTEST, FASTEST)
        angle = angle + SECONDS * speed
        height = angle.cos()
        held = (held + 1) * (height > UPRIGHT)
        reward = 0.01 * (1 + height) - 0.0001 * speed.square()
        never = torch.zeros_like(held, dtype=torch.bool)
        return Step(torch.stack([angle, speed, held], -1), reward, never, held >= HELD)

    def observe(self, state: Tensor, level: Values) -> Tensor:
        """Returns the angle's cosine and sine, the speed and the level, each about -1 to 1."""
        angle, speed, _ = state.unbind(-1)
        own = [level["mass"] - 1, level["length"] - 1, level["torque"] / 4 - 1]
        return torch.stack([angle.cos(), angle.sin(), speed / FASTEST, *own], -1)
